"""Parts of a batch, one per CPU thread: Warp releases the GIL while a kernel runs.

Warp's CPU backend runs a launch on the calling thread, so several threads use all cores. On a GPU a batch is one part,
halved until the memory suffices. A grasp's result does not depend on its part."""

import gc
import logging
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import TypeVar

import numpy as np
import warp as wp

from graspd.worker.engines.devices import is_out_of_memory
from graspd.worker.execution_context import ExecutionContext

log = logging.getLogger(__name__)
T = TypeVar("T")


class StepCounter:
    """Counter of the work of all threads; checks for cancellation."""

    def __init__(self, total: float, run: ExecutionContext) -> None:
        self._total, self._run = total, run
        self._done = 0.0
        self._lock = threading.Lock()

    def __call__(self, work: float, message: str) -> None:
        self._run.check("the synthesis")
        with self._lock:
            self._done += work
            # Grasps that are repeated in smaller parts count twice.
            self._run.progress(min(self._done, self._total), self._total, message)


def split_batch(count: int, run: ExecutionContext, *, least: int = 1) -> list[range]:
    """Cut a batch into contiguous, nearly equal parts: one on a GPU, at most one per thread on a CPU.
    Each part has at least `least` grasps."""
    if wp.get_device(run.device).is_cuda:
        return [range(count)]
    parts = max(1, min(run.cores, count // least))
    bounds = np.linspace(0, count, parts + 1).astype(int)
    return [range(int(a), int(b)) for a, b in pairwise(bounds)]


def run_parts(parts: list[range], work: Callable[[range], T]) -> list[T]:
    """Run `work` on every part, each in its own thread; return the results in the order of the parts.
    A part that exceeds a GPU's memory is halved, repeatedly if needed, down to single grasps. Halves run in sequence,
    so there may be more results than parts."""
    if len(parts) == 1:
        return _run_halved(parts[0], work)
    with ThreadPoolExecutor(len(parts), thread_name_prefix="synthesize") as pool:
        return [future.result() for future in [pool.submit(work, part) for part in parts]]


def _run_halved(part: range, work: Callable[[range], T]) -> list[T]:
    try:
        return [work(part)]
    except RuntimeError as error:
        if len(part) < 2 or not is_out_of_memory(error):
            raise
        log.warning(
            "too little memory on the GPU for %d grasps in one launch; two launches follow: %s", len(part), error
        )
    # The error is freed by now, and with it stack frames that held earlier allocations.
    gc.collect()
    middle = part.start + len(part) // 2
    return [*_run_halved(range(part.start, middle), work), *_run_halved(range(middle, part.stop), work)]
