"""How many batches go into one launch where nobody says."""

from __future__ import annotations

import re
from typing import Final

from service.model.domain import BATCH_SIZE
from service.model.errors import InputError

#: Grasps for each multiprocessor of a GPU: their 7 simulations for each of 2 finalists are four warps, one for each of
#: its schedulers. The kernels of a hand's points fill it long before.
GRASPS_PER_MULTIPROCESSOR: Final = 8
#: Memory that a grasp takes at the most, that of the fidelity `paper` [bytes], and share of the free memory to take.
BYTES_PER_GRASP: Final = 2.5 * 2**20
MEMORY_SHARE: Final = 0.5
#: More batches of one pair than this seldom wait.
MOST: Final = 64


def parse_join(text: str) -> int | None:
    """Batches in one launch; None: auto.

    Raises:
        InputError: neither a number from 1 on nor auto.
    """
    if text == "auto":
        return None
    if not re.fullmatch(r"[1-9][0-9]{0,3}", text):
        raise InputError(f"--join takes a number of batches from 1 to 9999, or auto; got {text!r}")
    return int(text)


def batches_at_once(device: str, join: int | None) -> int:
    """Batches in one launch on a Warp device: `join` where it is given; on the CPU 1, for a launch gains nothing by
    its size there; on a GPU as many as fill it and fit its free memory."""
    if join is not None or not device.startswith("cuda"):
        return join or 1
    import warp as wp

    found = wp.get_device(device)
    return fitting(int(found.sm_count), int(found.free_memory))


def fitting(multiprocessors: int, free_bytes: int) -> int:
    """A power of two, so that a launch is halved evenly; at least 1."""
    grasps = min(GRASPS_PER_MULTIPROCESSOR * multiprocessors, MEMORY_SHARE * free_bytes / BYTES_PER_GRASP)
    batches = max(1, min(MOST, int(grasps // BATCH_SIZE)))
    return 1 << (batches.bit_length() - 1)
