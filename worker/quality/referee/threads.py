"""Simulated tests of many grasps, each thread with a test of its own: a test owns the state of its simulation."""

from __future__ import annotations

import queue
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from worker.run import Run

Test = TypeVar("Test")
Answer = TypeVar("Answer")


def answers(
    rows: Sequence[int], make: Callable[[], Test], ask: Callable[[Test, int], Answer], *, threads: int, name: str
) -> list[Answer]:
    """What tests say of some grasps, in their order.

    Args:
        rows: the grasps.
        make: makes a test.
        ask: asks a test of a grasp.
        threads: at most.
        name: of the threads.
    """
    tests: queue.SimpleQueue[Test] = queue.SimpleQueue()
    workers = max(1, min(threads, len(rows)))
    for _ in range(workers):
        tests.put(make())

    def work(row: int) -> Answer:
        test = tests.get()
        try:
            return ask(test, row)
        finally:
            tests.put(test)

    with ThreadPoolExecutor(workers, thread_name_prefix=name) as pool:
        return list(pool.map(work, rows))


def measured(
    count: int, held: NDArray[np.bool_] | None, make: Callable[[], Test], ask: Callable[[Test, int], float], *,
    run: Run, name: str,
) -> NDArray[np.float64]:  # fmt: skip
    """(count,) what tests measure of the grasps that are `held` (count,), None: of all; nan of the others.

    Args:
        count: grasps.
        held: which of them are tested.
        make: makes a test; not called where there is nothing to test.
        ask: asks a test of a grasp.
        run: asked between grasps whether to stop.
        name: of the threads.

    Raises:
        TaskCancelled: when `run.cancelled()` answers True.
    """

    def asked(test: Test, row: int) -> float:
        run.check("the referee")
        return ask(test, row)

    out = np.full(count, np.nan)
    rows = np.arange(count) if held is None else np.flatnonzero(held)
    if len(rows):
        out[rows] = answers(rows.tolist(), make, asked, threads=run.cores, name=name)
    return out
