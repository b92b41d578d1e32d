"""A batch of grasps cut into parts, one per CPU thread: Warp releases the interpreter lock while a kernel runs.

Warp's CPU backend runs a launch on the thread that asks for it, so threads use all cores. A grasp's result does not
depend on the part it is in.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import TypeVar

import numpy as np
import warp as wp

from worker.run import Run

T = TypeVar("T")


class Steps:
    """Counts work done by all threads; looks at cancellation."""

    def __init__(self, total: float, run: Run) -> None:
        self._total, self._run = total, run
        self._done = 0.0
        self._lock = threading.Lock()

    def __call__(self, work: float, message: str) -> None:
        """Add done work; raises TaskCancelled."""
        self._run.check("the synthesis")
        with self._lock:
            self._done += work
            self._run.progress(self._done, self._total, message)


def cut(count: int, run: Run, *, least: int = 1) -> list[range]:
    """Contiguous, nearly equal parts of a batch: one on a GPU, at most one per thread on a CPU.

    Args:
        count: grasps.
        run: its device and threads.
        least: fewest grasps worth a thread of their own.
    """
    if wp.get_device(run.device).is_cuda:
        return [range(count)]
    parts = max(1, min(run.cores, count // least))
    bounds = np.linspace(0, count, parts + 1).astype(int)
    return [range(int(a), int(b)) for a, b in pairwise(bounds)]


def run_parts(parts: list[range], work: Callable[[range], T]) -> list[T]:
    """`work` of every part, each in a thread of its own, in order."""
    if len(parts) == 1:
        return [work(parts[0])]
    with ThreadPoolExecutor(len(parts), thread_name_prefix="synthesize") as pool:
        return [future.result() for future in [pool.submit(work, part) for part in parts]]
