"""Who is served together in a meeting, when, and what becomes of each."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from typing import Any

import pytest

from graspd.service.model.errors import TaskCancelled
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.meeting import Meeting
from tests.waiting import PATIENCE_S

#: Long enough that no test sees its end.
NEVER_S = 1000.0


def doubled(items: Sequence[Any]) -> list[Any]:
    return [ValueError("odd") if item % 2 else 2 * item for item in items]


def asked(
    meeting: Meeting, items: Sequence[int], work: Callable[[Sequence[Any]], Sequence[Any]] = doubled, key: str = "same"
) -> list[Any]:
    """What each of several members gets, in their order: a result or what was raised."""

    def one(item: int) -> Any:
        try:
            return meeting.ask(key, item, work, size=1, cancelled=lambda: False)
        except Exception as error:
            return error

    with ThreadPoolExecutor(len(items)) as pool:
        return list(pool.map(one, items))


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("graspd.worker.meeting.FIRST_WAIT_S", NEVER_S)


def test_all_members_who_wait_are_served_at_once() -> None:
    with Meeting(4, 100) as meeting:
        assert asked(meeting, [0, 2, 4, 6]) == [0, 4, 8, 12]
    assert meeting.served == [4]


def test_what_becomes_of_one_is_its_own() -> None:
    with Meeting(3, 100) as meeting:
        first, second, third = asked(meeting, [2, 3, 4])
    assert (first, third) == (4, 8)
    assert isinstance(second, ValueError)


def test_work_that_fails_for_all_is_tried_for_each() -> None:
    def not_robust(items: Sequence[Any]) -> list[Any]:
        if 3 in items:
            raise ArithmeticError("three")
        return [2 * item for item in items]

    with Meeting(3, 100) as meeting:
        first, second, third = asked(meeting, [2, 3, 4], not_robust)
    assert (first, third) == (4, 8)
    assert isinstance(second, ArithmeticError)


def test_no_launch_is_larger_than_the_most() -> None:
    with Meeting(5, 2) as meeting:
        assert asked(meeting, [0, 2, 4, 6, 8]) == [0, 4, 8, 12, 16]
        assert max(meeting.served) == 2


def test_a_full_launch_waits_for_nobody() -> None:
    with Meeting(9, 2) as meeting:
        assert asked(meeting, [0, 2]) == [0, 4]


def test_who_leaves_is_not_waited_for() -> None:
    with Meeting(2, 100) as meeting:
        meeting.leave()
        assert asked(meeting, [2]) == [4]


def test_nobody_waits_longer_than_a_launch_takes() -> None:
    with Meeting(3, 2) as meeting:
        asked(meeting, [0, 2])  # full: nobody waits, and now a launch is known to take no time
        assert asked(meeting, [8]) == [16]
    assert meeting.served == [2, 1]


def test_what_differs_is_not_done_together() -> None:
    seen: list[list[int]] = []

    def noting(items: Sequence[Any]) -> list[Any]:
        seen.append(sorted(items))
        return doubled(items)

    with Meeting(4, 100) as meeting, ThreadPoolExecutor(2) as pool:
        one = pool.submit(asked, meeting, [0, 2], noting, "a")
        two = pool.submit(asked, meeting, [4, 6], noting, "b")
        for _ in range(2):  # one key is served where all four wait, the other when those who were served have left
            wait((one, two), return_when=FIRST_COMPLETED)
            meeting.leave()
            meeting.leave()
        assert (one.result(), two.result()) == ([0, 4], [8, 12])
    assert sorted(seen) == [[0, 2], [4, 6]]


def test_what_fills_a_launch_goes_before_what_was_asked_for_earlier() -> None:
    order: list[str] = []

    def noting(name: str) -> Callable[[Sequence[Any]], list[Any]]:
        def work(items: Sequence[Any]) -> list[Any]:
            order.append(name)
            return list(items)

        return work

    with Meeting(4, 2) as meeting, ThreadPoolExecutor(1) as pool:
        early = pool.submit(meeting.ask, "early", 1, noting("early"), size=1, cancelled=lambda: False)
        while not meeting._seats:
            threading.Event().wait(0.005)
        asked(meeting, [2, 4], noting("full"), "full")
        meeting.leave()
        meeting.leave()
        meeting.leave()
        early.result(timeout=PATIENCE_S)
    assert order == ["full", "early"]


def test_who_is_cancelled_waits_no_longer_and_is_not_served() -> None:
    stop = threading.Event()
    with Meeting(2, 100) as meeting, ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(meeting.ask, "same", 2, doubled, size=1, cancelled=stop.is_set)
        stop.set()
        with pytest.raises(TaskCancelled):
            waiting.result(timeout=PATIENCE_S)
        meeting.leave()
        assert asked(meeting, [4]) == [8]
    assert meeting.served == [1]


def test_members_share_the_cores() -> None:
    meeting = Meeting(3, 100)
    assert ExecutionContext(threads=8, meeting=meeting).cores == 2
    assert ExecutionContext(threads=8, meeting=meeting).apart().cores == 8
    meeting.leave()
    assert ExecutionContext(threads=8, meeting=meeting).cores == 4
