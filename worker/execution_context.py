"""Execution context of a computation (device, progress, cancellation, shared cores); parallel maps."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from dataclasses import dataclass, field, replace
from typing import Final, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.cores import available_cores
from graspd.service.model.errors import TaskCancelled
from graspd.worker.pool.pool import Pool

PrefilterMode = Literal["auto", "on", "off"]
#: Receives the amount done, the total and a short message; called often, by any thread.
Progress = Callable[[float, float, str], None]
#: Returns whether to stop; called often, by any thread.
Cancelled = Callable[[], bool]


class CoreSharing:
    """Number of parallel parts that share the cores; a finished part frees its cores for the others."""

    def __init__(self, members: int) -> None:
        self.members = members
        self._lock = threading.Lock()

    def leave(self) -> None:
        with self._lock:
            self.members -= 1


@dataclass(frozen=True)
class ExecutionContext:
    """Where and how a computation runs.
    Results are independent of it, except for rounding on a GPU and for the engine that validates."""

    device: str = "cpu"
    threads: int = 0
    """CPU threads; 0 for one per core that this process may use."""
    progress: Progress = lambda done, total, message: None
    cancelled: Cancelled = lambda: False
    prefilter: PrefilterMode = "auto"
    """Whether MuJoCo Warp decides clear verdicts; auto: on a GPU, if it is installed."""
    pool: Pool | None = None
    """Processes for validation and measurement; None for threads of this process."""
    sharing: CoreSharing | None = None
    """Parallel parts, including this one, that share the cores; None if all cores are available."""

    @property
    def cores(self) -> int:
        """Number of CPU threads for this part: an equal share of `threads`, or of all available cores."""
        every = self.threads or available_cores()
        return every if self.sharing is None else max(1, every // max(1, self.sharing.members))

    def with_progress_range(self, start: float, end: float) -> ExecutionContext:
        """Return the context of a part, with progress from `start` to `end` as shares of the whole."""

        def report(done: float, total: float, message: str) -> None:
            self.progress(start + (end - start) * (done / total if total > 0 else 0.0), 1.0, message)

        return replace(self, progress=report)

    def without_progress(self) -> ExecutionContext:
        return replace(self, progress=DEFAULT_CONTEXT.progress)

    def check(self, what: str) -> None:
        if self.cancelled():
            raise TaskCancelled(f"{what} was cancelled")


class Count:
    def __init__(self, total: int, run: ExecutionContext, what: str, done: int = 0) -> None:
        self._total, self._run, self._what, self._done = total, run, what, done
        self._lock = threading.Lock()

    def add(self, more: int) -> None:
        with self._lock:
            self._done += more
            self._run.progress(self._done, self._total, self._what)


#: CPU with all its cores, without progress or cancellation.
DEFAULT_CONTEXT: Final = ExecutionContext()


T = TypeVar("T")
R = TypeVar("R")


@dataclass
class ProgressShares:
    """Combined progress of all parts, weighted by their sizes."""

    sizes: Sequence[int]
    told: Progress
    _done: dict[int, float] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def progress_of_part(self, part: int) -> Progress:
        def report(done: float, total: float, message: str) -> None:
            with self._lock:
                self._done[part] = self.sizes[part] * (done / total if total > 0 else 0.0)
                self.told(sum(self._done.values()), sum(self.sizes), message)

        return report


def parallel_map(
    parts: Sequence[T], work: Callable[[T, ExecutionContext], R], run: ExecutionContext, *, size: Callable[[T], int]
) -> list[R]:
    """Run `work` on every part in parallel; return the results in the order of `parts`.
    Each part has an equal share of the cores, and a share of the progress in proportion to its `size`. The first
    failure stops the others; its error is raised once all have ended."""
    if len(parts) == 1:
        return [work(parts[0], run)]
    sharing, stop = CoreSharing(len(parts)), threading.Event()
    shares = ProgressShares([size(part) for part in parts], run.progress)

    def run_part(number: int) -> R:
        own = replace(
            run,
            sharing=sharing,
            progress=shares.progress_of_part(number),
            cancelled=lambda: stop.is_set() or run.cancelled(),
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


def evaluate_rows(
    rows: Sequence[int], make: Callable[[], T], ask: Callable[[T, int], R], *, threads: int, name: str
) -> list[R]:
    """Run `ask` on grasps `rows` in parallel, with a test per thread; return results in order of `rows`."""
    if not len(rows):
        return []
    if (workers := min(threads, len(rows))) <= 1:
        test = make()
        return [ask(test, row) for row in rows]
    tests: queue.SimpleQueue[T] = queue.SimpleQueue()
    for _ in range(workers):
        tests.put(make())

    def evaluate_row(row: int) -> R:
        test = tests.get()
        try:
            return ask(test, row)
        finally:
            tests.put(test)

    with ThreadPoolExecutor(workers, thread_name_prefix=name) as pool:
        return list(pool.map(evaluate_row, rows))


def measure_rows(
    count: int,
    held: NDArray[np.bool_] | None,
    make: Callable[[], T],
    ask: Callable[[T, int], float],
    *,
    run: ExecutionContext,
    name: str,
) -> NDArray[np.float64]:
    """Return measurements (count,), nan for grasps not `held` (count,); if `held` is None, of all grasps."""

    def evaluate_row(test: T, row: int) -> float:
        run.check("the validator")
        return ask(test, row)

    out = np.full(count, np.nan)
    rows = np.arange(count) if held is None else np.flatnonzero(held)
    out[rows] = evaluate_rows(rows.tolist(), make, evaluate_row, threads=run.cores, name=name)
    return out
