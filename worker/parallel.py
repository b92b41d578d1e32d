"""Parallel parts of one computation, each with its share of the cores."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from dataclasses import dataclass, field, replace
from typing import TypeVar

from graspd.worker.execution_context import CoreSharing, ExecutionContext, Progress

T = TypeVar("T")
R = TypeVar("R")


@dataclass
class ProgressShares:
    """Combined progress of all parts, in the unit of their sizes."""

    sizes: Sequence[int]
    told: Progress
    _done: dict[int, float] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def of(self, part: int) -> Progress:
        def tell(done: float, total: float, message: str) -> None:
            with self._lock:
                self._done[part] = self.sizes[part] * (done / total if total > 0 else 0.0)
                self.told(sum(self._done.values()), sum(self.sizes), message)

        return tell


def parallel_map(
    parts: Sequence[T], work: Callable[[T, ExecutionContext], R], run: ExecutionContext, *, size: Callable[[T], int]
) -> list[R]:
    """Run `work` on every part in parallel; return the results in order.
    Each part has its own share of the cores, and of the progress by `size`. The first failure stops the others.

    Raises:
        Exception: the error of the first part that failed, once all have ended.
    """
    if len(parts) == 1:
        return [work(parts[0], run)]
    sharing, stop, shares = (
        CoreSharing(len(parts)),
        threading.Event(),
        ProgressShares([size(part) for part in parts], run.progress),
    )

    def run_part(number: int) -> R:
        own = replace(
            run, sharing=sharing, progress=shares.of(number), cancelled=lambda: stop.is_set() or run.cancelled()
        )
        try:
            return work(parts[number], own)
        finally:
            sharing.leave()

    with ThreadPoolExecutor(len(parts), thread_name_prefix="part") as pool:
        futures = [pool.submit(run_part, number) for number in range(len(parts))]
        try:
            done, _ = wait(futures, return_when=FIRST_EXCEPTION)
        finally:
            stop.set()
    if failed := [error for one in done if (error := one.exception()) is not None]:
        raise failed[0]
    return [one.result() for one in futures]
