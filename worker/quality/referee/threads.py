"""Simulated tests of many grasps, each thread with a test of its own: a test owns the state of its simulation."""

from __future__ import annotations

import queue
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

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
