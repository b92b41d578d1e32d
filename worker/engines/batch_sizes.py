"""Default numbers of batches per launch, and of processes that validate and measure."""

from pathlib import Path
from typing import Final

from graspd.service.model.cores import ROOT, available_cores, available_memory
from graspd.service.model.domain import BATCH_SIZE

#: Grasps per multiprocessor of a GPU. With 2 finalists of 7 simulations each, 8 grasps fill four warps, one for each
#: scheduler. Kernels over hand points need fewer grasps to fill the GPU.
GRASPS_PER_MULTIPROCESSOR: Final = 8
#: Largest memory of a grasp, at fidelity `paper` [bytes], and the used share of the free memory.
BYTES_PER_GRASP: Final = 2.5 * 2**20
MEMORY_SHARE: Final = 0.5
MOST: Final = 64  # largest number of batches per launch: the queue seldom has more batches of one pair
#: Largest memory of a process with the models of its cached pairs [bytes]; see docs/explanation/performance.md.
BYTES_PER_PROCESS: Final = 400 * 2**20
PROCESS_SHARE: Final = 0.25  # share of the machine's memory for these processes


def batches_per_launch(device: str, join: int | None) -> int:
    """Return the batches per launch on a Warp device: `join` if given, else 1 on the CPU.
    On a GPU the default fills the GPU within its free memory."""
    if join is not None or not device.startswith("cuda"):
        return join or 1
    import warp as wp

    found = wp.get_device(device)
    return batches_that_fit(int(found.sm_count), int(found.free_memory))


def batches_that_fit(multiprocessors: int, free_bytes: int) -> int:
    """Return the number of batches that fit: at least 1, and a power of two, to halve launches evenly."""
    grasps = min(GRASPS_PER_MULTIPROCESSOR * multiprocessors, MEMORY_SHARE * free_bytes / BYTES_PER_GRASP)
    batches = max(1, min(MOST, int(grasps // BATCH_SIZE)))
    return 1 << (batches.bit_length() - 1)


def pool_process_count(device: str, wanted: int, *, threads: int = 0, workers: int = 1, root: Path = ROOT) -> int:
    """Return how many processes validate and measure: `wanted` if not 0; 1 for the worker's threads alone.
    On a GPU the default is one less than the worker's share of the cores, within a quarter of the memory for all
    `workers`. On a CPU the planner needs all cores, so the default is 1."""
    if wanted or not device.startswith("cuda"):
        return wanted or 1
    room = int(PROCESS_SHARE * available_memory(root) / workers / BYTES_PER_PROCESS)
    cores = min(threads or available_cores(root), max(1, available_cores(root) // workers))
    return max(1, min(cores - 1, room))
