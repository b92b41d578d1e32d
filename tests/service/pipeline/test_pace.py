"""Work that grows with the fleet is done less often, and leases are still seen three times."""

from __future__ import annotations

import pytest

from service.pipeline.controller import Pace


class Clock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now

    def spend(self, seconds: float) -> None:
        self.now += seconds


@pytest.mark.parametrize(
    ("cost_s", "pause_s"), [(0.0, 1.0), (0.25, 1.0), (1.0, 4.0), (3.0, 6.0)], ids=["free", "cheap", "dear", "bounded"]
)
def test_the_pause_follows_from_the_cost(cost_s: float, pause_s: float) -> None:
    clock = Clock()
    pace = Pace(clock, 1.0, share=0.2, longest_s=6.0)
    assert pace.is_due
    pace.run(lambda: clock.spend(cost_s))
    clock.spend(pause_s - 0.01)
    assert not pace.is_due
    clock.spend(0.02)
    assert pace.is_due


def test_what_broke_off_is_due_at_once() -> None:
    pace = Pace(Clock(), 1.0)
    with pytest.raises(ZeroDivisionError):
        pace.run(lambda: 1 / 0)
    assert pace.is_due
