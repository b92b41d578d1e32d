"""Many worlds at once come to the standard level's verdicts, by the same looks, whatever order they take grasps in."""

from __future__ import annotations

import numpy as np
import pytest

from graspd.service.model.errors import TaskCancelled
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.grasps import GraspSet, joined
from graspd.worker.validation.model import MujocoOptions, build
from graspd.worker.validation.prefilter import prefilter as screening
from graspd.worker.validation.prefilter.phases import PrefilterOutcomes
from graspd.worker.validation.prefilter.prefilter import ROWS, WorldPool
from graspd.worker.validation.protocol import Outcome
from graspd.worker.validation.validator import Verdicts, validate
from tests.worker.quality.helpers import posture
from tests.worker.validation.prefilter.engine import Stand
from tests.worker.validation.test_validator import BOX, PADS, WHOLE, grasp_of, many_grasps


def every_kind() -> GraspSet:
    """Grasps that hold, that lose the box while closing or when pushed, and one that starts inside it."""
    away, deep = posture(((0, 0, -0.5), (0.0, 0.0))), posture(((0, 0, 0), (0.08, 0.08)))
    inside = GraspSet(deep, deep, deep, np.full(1, np.nan))
    open_, shut = posture(((0, 0, 0), (0.05, 0.0))), posture(((0, 0, 0), (0.15, 0.0)))
    kicked = GraspSet(open_, open_, shut, np.full(1, np.nan))
    return joined([many_grasps(), inside, kicked, grasp_of(contact=away), grasp_of(force=10.0)])


def pool(monkeypatch: pytest.MonkeyPatch, engine: Stand, size: int) -> WorldPool:
    monkeypatch.setattr(screening, "mujoco_warp", lambda: engine)
    return WorldPool(build(PADS, BOX, WHOLE, MujocoOptions()), "cpu", size)


@pytest.fixture(scope="module")
def standard() -> Verdicts:
    return validate(PADS, BOX, every_kind(), pieces=WHOLE)


@pytest.fixture(scope="module")
def found() -> PrefilterOutcomes:
    with pytest.MonkeyPatch.context() as monkeypatch:
        return pool(monkeypatch, Stand(), 4).validate(every_kind())


def test_outcomes_are_the_certificates(found: PrefilterOutcomes, standard: Verdicts) -> None:
    kinds = {Outcome(int(one)) for one in standard.outcome.ravel()}
    assert kinds >= {Outcome.HELD, Outcome.PENETRATION, Outcome.LOST_WHILE_CLOSING, Outcome.DISPLACED}
    np.testing.assert_array_equal(found.outcome, standard.outcome)
    np.testing.assert_array_equal(found.held, standard.success == 1)


def test_margins_and_depths_are_the_certificates(found: PrefilterOutcomes, standard: Verdicts) -> None:
    held = standard.success == 1
    # State is single precision between two steps; a creep of 1e-5 of the limit in a push is what that makes.
    np.testing.assert_allclose(found.margin[held], standard.margin[held], atol=2e-3)
    np.testing.assert_allclose(1e3 * found.penetration_m, standard.penetration_depth_mm, atol=1e-3)
    np.testing.assert_allclose(1e3 * found.self_penetration_m, standard.self_penetration_depth_mm, atol=1e-3)


def test_a_grasp_that_holds_takes_the_steps_of_the_certificate(found: PrefilterOutcomes) -> None:
    alone = validate(PADS, BOX, grasp_of(), pieces=WHOLE)
    assert found.ticks[0] * 10 == alone.steps


def test_verdicts_do_not_depend_on_which_world_takes_a_grasp(
    found: PrefilterOutcomes, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = np.arange(len(found.outcome))[::-1]
    other = pool(monkeypatch, Stand(), 3).validate(every_kind().take(rows))
    np.testing.assert_array_equal(other.outcome[rows], found.outcome)
    np.testing.assert_array_equal(other.margin[rows], found.margin)


def test_grasps_that_need_more_room_are_validated_again_with_it(
    standard: Verdicts, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = pool(monkeypatch, Stand(needs_rows=ROWS + 1), 4).validate(every_kind())
    assert not found.overflow.any()
    np.testing.assert_array_equal(found.outcome, standard.outcome)


def test_what_finds_no_room_is_said_and_never_clear(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(screening, "DOUBLINGS", 1)
    found = pool(monkeypatch, Stand(needs_rows=1 << 30), 4).validate(grasp_of())
    assert found.held.all()
    assert found.overflow.all()
    assert not (found.clearly_held | found.clearly_failed).any()


def test_a_simulation_that_blows_up_is_never_clear(monkeypatch: pytest.MonkeyPatch) -> None:
    found = pool(monkeypatch, Stand(diverges=True), 1).validate(grasp_of())
    assert Outcome.DIVERGED in found.outcome[0]
    assert not (found.clearly_held | found.clearly_failed).any()


def test_the_band_is_clear_of_neither_side() -> None:
    n, held = 4, [Outcome.HELD] * 6
    lost = [Outcome.DISPLACED] + [Outcome.NOT_TRIED] * 5
    found = PrefilterOutcomes(
        outcome=np.array([held, held, lost, lost], np.uint8),
        margin=np.array([0.79, 0.81, 1.19, 1.21]),
        penetration_m=np.zeros(n),
        self_penetration_m=np.zeros(n),
        overflow=np.zeros(n, bool),
        ticks=np.zeros(n, np.int32),
    )
    assert found.clearly_held.tolist() == [True, False, False, False]
    assert found.clearly_failed.tolist() == [False, False, False, True]


def test_it_stops_when_told(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(TaskCancelled):
        pool(monkeypatch, Stand(), 4).validate(many_grasps(), ExecutionContext(cancelled=lambda: True))
