"""When a certificate ends a push: as soon as the present rate keeps the object well inside the limits for 2 s."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from graspd.worker.validation.protocol import HOLD_S, MAX_DISPLACEMENT_M, MAX_ROTATION, Outcome, Rollout, Test


class Scripted(Test):
    """A push in which displacement and rotation, over their limits, follow functions of time [s]."""

    def __init__(self, moved: Callable[[float], float], turned: Callable[[float], float]) -> None:
        self._moved, self._turned, self.elapsed = moved, turned, 0.0

    def _run(self, seconds: float) -> None:
        self.elapsed += seconds

    def _offset(self) -> np.ndarray:
        return np.array([MAX_DISPLACEMENT_M * self._moved(self.elapsed), 0.0, 0.0])

    def _motion(self) -> tuple[float, float]:
        return float(np.linalg.norm(self._offset())), MAX_ROTATION * self._turned(self.elapsed)

    def _validate(self, rollout: Rollout) -> Outcome:
        moved, turned = self._motion()
        if moved >= MAX_DISPLACEMENT_M:
            return Outcome.DISPLACED
        return Outcome.ROTATED if turned >= MAX_ROTATION else Outcome.HELD


def still(time: float) -> float:
    return 0.0


def creeping(share: float) -> Callable[[float], float]:
    """At a rate that would reach so much of the limit in 2 s, and ten times as fast from half a second on."""
    rate = share / HOLD_S
    return lambda time: rate * (min(time, 0.5) + 10.0 * max(0.0, time - 0.5))


def test_what_stands_still_is_held_at_the_first_look() -> None:
    push = Scripted(still, still)
    assert push._hold(Rollout()) is Outcome.HELD
    assert push.elapsed == pytest.approx(0.08)


def test_what_creeps_slowly_is_held_early() -> None:
    push = Scripted(creeping(0.4), creeping(0.4))
    assert push._hold(Rollout()) is Outcome.HELD
    assert push.elapsed == pytest.approx(0.08)


def test_what_would_come_near_a_limit_is_watched_until_it_breaks_it() -> None:
    assert Scripted(creeping(0.7), still)._hold(Rollout()) is Outcome.DISPLACED
    assert Scripted(still, creeping(0.7))._hold(Rollout()) is Outcome.ROTATED
