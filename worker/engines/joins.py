"""How many batches go into one launch, and how many processes validate and measure, where nobody says."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from graspd.service.model.cores import ROOT, available_cores, available_memory
from graspd.service.model.domain import BATCH_SIZE

#: Grasps for each multiprocessor of a GPU: their 7 simulations for each of 2 finalists are four warps, one for each of
#: its schedulers. The kernels of a hand's points fill it long before.
GRASPS_PER_MULTIPROCESSOR: Final = 8
#: Memory that a grasp takes at the most, that of the fidelity `paper` [bytes], and share of the free memory to take.
BYTES_PER_GRASP: Final = 2.5 * 2**20
MEMORY_SHARE: Final = 0.5
#: More batches of one pair than this seldom wait.
MOST: Final = 64
#: Memory that a process takes at the most, with the models of the pairs that it keeps [bytes]; see
#: docs/explanation/performance.md.
BYTES_PER_PROCESS: Final = 400 * 2**20
#: Share of the machine's memory for them.
PROCESS_SHARE: Final = 0.25


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


def processes_at_once(device: str, wanted: int, *, threads: int = 0, workers: int = 1, root: Path = ROOT) -> int:
    """Processes that validate and measure; 1: the worker's own, with threads.

    Where nobody says, a worker on a GPU has one for each core but its own, as far as a quarter of the memory goes. On a
    CPU the planner takes the same cores at other times, and threads do.

    Args:
        device: Warp device of the planner.
        wanted: so many; 0: nobody says.
        threads: CPU threads of the worker; 0: one for each core.
        workers: of this machine, which share its cores and its memory.
        root: the folder that holds `proc` and `sys`.
    """
    if wanted or not device.startswith("cuda"):
        return wanted or 1
    room = int(PROCESS_SHARE * available_memory(root) / workers / BYTES_PER_PROCESS)
    cores = min(threads or available_cores(root), max(1, available_cores(root) // workers))
    return max(1, min(cores - 1, room))
