"""Work that grows with the fleet is done less often, and leases are still seen three times."""

from __future__ import annotations

import contextlib
from collections.abc import Callable

import pytest

from service.pipeline.controller import Duty
from tests.waiting import Clock


@pytest.mark.parametrize(
    ("cost_s", "pause_s"), [(0.0, 1.0), (0.25, 1.0), (1.0, 4.0), (3.0, 6.0)], ids=["free", "cheap", "dear", "bounded"]
)
def test_the_pause_follows_from_the_cost(cost_s: float, pause_s: float) -> None:
    clock, done = Clock(), list[float]()

    def work() -> None:
        clock.now += cost_s
        done.append(clock.now)

    duty = Duty(clock, work, 1.0, share=0.2, longest_s=6.0)
    duty()
    clock.now += pause_s - 0.01
    duty()
    assert len(done) == 1
    clock.now += 0.02
    duty()
    assert len(done) == 2


@pytest.mark.parametrize("work", [lambda: 1 / 0, lambda: True], ids=["broke off", "has more to do"])
def test_what_is_not_done_is_due_at_once(work: Callable[[], object]) -> None:
    begun: list[int] = []
    duty = Duty(Clock(), lambda: begun.append(1) or work(), 1.0)  # type: ignore[func-returns-value]
    for _ in range(2):
        with contextlib.suppress(ZeroDivisionError):
            duty()
    assert len(begun) == 2
