"""The trial of candidates is the test of the validator itself, which is then not done again."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from graspd.worker.execution_context import ExecutionContext
from graspd.worker.grasps import GraspSet, joined
from graspd.worker.scenes import rollout as rollouts
from graspd.worker.scenes.rollout import BEST, FALLS, TOUCHES, hold_rollout, lift_rollout, scene_verdicts
from graspd.worker.simulation.environment import PlacedGrasps
from graspd.worker.validation.lift import Lift
from graspd.worker.validation.lifting import KnownLifts, LiftLevel, validate_lifts
from graspd.worker.validation.prescreening import SLIPS, LiftRollouts
from graspd.worker.validation.protocol import Test
from graspd.worker.validation.validator import KnownRollouts, validate
from tests.worker.validation.test_lift import BOX, HAND, LEAST, PLACED, WHOLE, grasp

SQUEEZES = (-0.005, 1.3 * LEAST, 4 * LEAST)
MANY = joined([grasp(squeeze) for squeeze in SQUEEZES])
WHERE = PlacedGrasps(PLACED.supports, PLACED.object_pose, np.zeros(3, int))


@pytest.fixture
def lifts(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Grows by the row of each lift that is simulated."""
    done: list[int] = []
    lift = Lift.lift
    monkeypatch.setattr(Lift, "lift", lambda self, grasps, row: done.append(row) or lift(self, grasps, row))
    return done


def test_what_was_validated_once_is_not_simulated_again(lifts: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    known: KnownLifts = {}
    first = validate_lifts(HAND, BOX, MANY, WHERE, pieces=WHOLE, known=known)
    again = validate_lifts(HAND, BOX, MANY, WHERE, pieces=WHOLE, known=known)
    assert len(lifts) == 3
    assert np.array_equal(first.outcome, again.outcome) and np.array_equal(first.margin, again.margin)
    rows: list[int] = []
    standard = Test.standard
    monkeypatch.setattr(Test, "standard", lambda self, given, row: rows.append(row) or standard(self, given, row))
    known: KnownRollouts = {}
    first = validate(HAND, BOX, MANY, pieces=WHOLE, known=known)
    again = validate(HAND, BOX, MANY.take(np.array([2, 0])), pieces=WHOLE, known=known)
    assert sorted(rows) == [0, 1, 2]
    assert np.array_equal(again.outcome, first.outcome[[2, 0]])
    validate(HAND, BOX, MANY, pieces=WHOLE, hard=True, known=known)
    assert len(rows) == 6


@pytest.mark.parametrize("other", ["friction", "squeeze", "scene"])
def test_a_lift_of_anything_else_is_not_known(lifts: list[int], other: str) -> None:
    known: KnownLifts = {}
    validate_lifts(HAND, BOX, MANY, WHERE, pieces=WHOLE, known=known)
    grasps, where = MANY, WHERE
    if other == "squeeze":
        grasps = joined([grasp(squeeze + 1e-6) for squeeze in SQUEEZES])
    if other == "scene":
        where = PlacedGrasps(PLACED.supports, PLACED.object_pose + np.array([1e-6, 0, 0, 0, 0, 0, 0]), WHERE.index)
    validate_lifts(HAND, BOX, grasps, where, pieces=WHOLE, hard=other == "friction", known=known)
    assert len(lifts) == 6


LIFTED, TOUCHED, FELL = 1, 3, 5


def numbered(count: int) -> GraspSet:
    """Grasps that are told apart by their loss."""
    return replace(MANY.take(np.zeros(count, int)), stability_loss=np.arange(float(count)), scene=np.zeros(count, int))


def lift_tests(monkeypatch: pytest.MonkeyPatch, outcomes: dict[bool, list[int]]) -> list[object]:
    """Stands in for the lift test at half the friction (True) and at the whole of it; grows by what is tested."""
    done: list[object] = []

    def validated(hand, obj, some, placed, *, hard=False, **_):
        rows = some.stability_loss.astype(int)
        done.append((hard, rows.tolist()))
        outcome = np.array(outcomes[hard])[rows]
        return SimpleNamespace(success=(outcome == LIFTED).astype(int), outcome=outcome, margin=np.zeros(len(rows)))

    def way(hand, obj, some, placed):
        clear, wrist = np.ones(len(some), bool), np.zeros((len(some), 0))
        seen = {"approach": some.approach, "open": some.coming, "lift": None, "least": 1.0 * clear, "wrist": wrist}
        return SimpleNamespace(clear=clear, **seen)

    monkeypatch.setattr(rollouts, "validate_lifts", validated)
    monkeypatch.setattr(rollouts, "plan_way", way)
    return done


def rollout_of(monkeypatch, scores: list[float], outcomes, beat=None, level: LiftLevel = "lift"):
    lift_tests(monkeypatch, outcomes)
    monkeypatch.setattr(LiftRollouts, "scores", lambda *_: np.array(scores))
    where = WHERE.take(np.zeros(len(scores), int))
    rollout = lift_rollout(HAND, BOX, lambda: WHOLE, level=level)
    return rollout(numbered(len(scores)), where, np.full(len(scores), np.inf) if beat is None else beat)


def test_a_score_is_that_of_the_lift(monkeypatch: pytest.MonkeyPatch) -> None:
    half = [LIFTED, FELL, FELL, FELL, FELL, TOUCHED, FELL]
    outcomes = {True: half, False: [LIFTED, LIFTED, FELL, LIFTED, FELL, TOUCHED, FELL]}
    found = rollout_of(monkeypatch, [0.2, 0.3, 0.4, 1.2, 1.3, 0.5, 4.0], outcomes)
    falls = SLIPS + 1.0 + FALLS * np.array([0.4, 1.0])
    assert found == pytest.approx([0.2, SLIPS, falls[0], 1.2, falls[1], 0.5 + TOUCHES, 4.0])
    assert found[0] <= BEST


def test_lifting_at_half_the_friction_is_asked_to_be_better(monkeypatch: pytest.MonkeyPatch) -> None:
    outcomes = {True: [LIFTED, FELL], False: [LIFTED, LIFTED]}
    assert rollout_of(monkeypatch, [0.2, 0.3], outcomes, np.array([1.5, 1.5])) == pytest.approx([0.2, 1.5])


def test_the_published_lift_is_at_full_friction(monkeypatch: pytest.MonkeyPatch) -> None:
    outcomes = {True: [LIFTED, LIFTED, FELL], False: [LIFTED, FELL, LIFTED]}
    found = rollout_of(monkeypatch, [0.2, 0.3, 0.4], outcomes, level="dexgraspbench")
    assert found == pytest.approx([0.2, SLIPS + 1.0 + FALLS * 0.3, SLIPS])
    assert rollout_of(monkeypatch, [0.3], {True: [LIFTED], False: [FELL]}) == pytest.approx([0.3]), "at level lift"


@pytest.mark.parametrize(
    ("level", "tested", "success", "hard"),
    [
        ("lift", [(True, [0, 1, 2, 3]), (False, [2, 3])], [1, 1, 1, 0], [1, 1, 0, -1]),
        ("dexgraspbench", [(False, [0, 1, 2, 3]), (True, [0, 2])], [1, 0, 1, 0], [1, -1, 0, -1]),
    ],
)
def test_no_grasp_is_lifted_that_another_lift_decides(monkeypatch, level: LiftLevel, tested, success, hard) -> None:
    done = lift_tests(monkeypatch, {True: [LIFTED, LIFTED, FELL, FELL], False: [LIFTED, FELL, LIFTED, FELL]})
    scenes = SimpleNamespace(placed=lambda _: WHERE.take(np.zeros(4, int)))
    _, columns = scene_verdicts(HAND, BOX, numbered(4), scenes, level=level, pieces=WHOLE, run=ExecutionContext())
    assert done == tested
    assert (columns["quality/success"].tolist(), columns["quality/lift_hard"].tolist()) == (success, hard)


@pytest.mark.parametrize(("verdict", "score"), [(1, 0.2), (0, SLIPS + 1.0 + FALLS * 0.2)])
def test_free_grasp_that_the_validator_drops_is_no_good_candidate(monkeypatch, verdict: int, score: float) -> None:
    monkeypatch.setattr(rollouts, "push_rollout", lambda *_: lambda grasps, *_: np.array([0.2, 4.0, 4.0]))
    monkeypatch.setattr(rollouts, "validate", lambda *_, **__: SimpleNamespace(success=np.array([verdict])))
    assert hold_rollout(HAND, BOX, lambda: WHOLE)(MANY, None).tolist() == pytest.approx([score, 4.0, 4.0])


def test_a_free_grasp_that_cannot_beat_another_is_not_validated(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rollouts, "push_rollout", lambda *_: lambda grasps, *_: np.array([0.6, 0.7, 0.8]))
    validated: list[int] = []
    held = SimpleNamespace(success=np.ones(1))
    monkeypatch.setattr(rollouts, "validate", lambda hand, obj, grasps, **_: validated.append(len(grasps)) or held)
    found = hold_rollout(HAND, BOX, lambda: WHOLE)(MANY, None, np.array([0.5, 0.7, np.inf]))
    assert (validated, found.tolist()) == ([1], [0.6, 0.7, 0.8])
