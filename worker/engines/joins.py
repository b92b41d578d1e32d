"""How many batches go into one launch where nobody says, and how many are at work for each of them."""

from __future__ import annotations

from typing import Final

from graspd.service.model.domain import BATCH_SIZE

#: Grasps for each multiprocessor of a GPU: their 7 simulations for each of 2 finalists are four warps, one for each of
#: its schedulers. The kernels of a hand's points fill it long before.
GRASPS_PER_MULTIPROCESSOR: Final = 8
#: Memory that a grasp takes at the most, that of the fidelity `paper` [bytes], and share of the free memory to take.
BYTES_PER_GRASP: Final = 2.5 * 2**20
MEMORY_SHARE: Final = 0.5
#: More batches of one pair than this seldom wait.
MOST: Final = 64
#: Batches at work for each one in a launch: while one half is on the device, the other is validated and measured.
PER_LAUNCH: Final = 2


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
