"""Robustness in scenes: grasps that lift are lifted in models around the nominal one."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from graspd.service.model.errors import InputError
from graspd.service.model.metrics import Axis
from graspd.service.model.transforms import quat_from_axis_angle, quat_rotate
from graspd.worker.grasps import GraspSet, joined
from graspd.worker.simulation.environment import PlacedGrasps
from graspd.worker.validation.lift import LiftOutcome, LiftTest
from graspd.worker.validation.lifting import validate_lifts
from graspd.worker.validation.model import FRICTION, HARD, MujocoOptions
from graspd.worker.validation.protocol import STAGES
from graspd.worker.validation.robust import robust
from graspd.worker.validation.variant import NOMINAL, Variant
from graspd.worker.validation.varied import Models, VariantLift, motion_of, seen, upright
from tests.worker.validation.test_lift import BOX, HAND, PLACED, WHOLE, beside, grasp

#: From a pull that slips even at the nominal friction to one that holds at half of it, and one that comes from below.
SQUEEZES = (0.0005, 0.009, 0.012, 0.015, 0.02, 0.05)
MANY = joined([*(grasp(one) for one in SQUEEZES), grasp(0.05, np.array([0, 0, 1.0]))])
WHERE = dataclasses.replace(PLACED, index=np.zeros(len(MANY), int))


def models(friction: tuple[float, float] = FRICTION) -> Models:
    return Models(HAND, BOX, WHOLE, MujocoOptions(friction=friction), PLACED.supports)


def by_luck(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lifts that succeed as a coin falls that follows from the grasp and the variant."""

    def lift(self: Models, grasps: GraspSet, row: int, placed: PlacedGrasps, variant: Variant, **_: object) -> LiftTest:
        words = np.frombuffer(repr((variant, grasps.squeeze.joint_positions[row].tolist())).encode(), np.uint8)
        lifted = np.random.default_rng(words.tolist()).random() < 0.7
        return LiftTest(LiftOutcome.LIFTED if lifted else LiftOutcome.NOT_LIFTED)

    monkeypatch.setattr(Models, "lift", lift)


@pytest.mark.parametrize("level", ["dexgraspbench", "lift"])
def test_the_nominal_model_has_the_verdicts_of_the_lift_test_bit_for_bit(level: str) -> None:
    verdicts = validate_lifts(HAND, BOX, MANY, WHERE, level=level, pieces=WHOLE)  # type: ignore[arg-type]
    found = [
        models().lift(MANY, row, WHERE, NOMINAL, dexgraspbench=level == "dexgraspbench") for row in range(len(MANY))
    ]
    assert [rollout.outcome for rollout in found] == verdicts.outcome.tolist()
    assert [rollout.margin for rollout in found] == verdicts.margin.tolist()
    assert {0, 1} == set(verdicts.success.tolist())


def test_half_the_friction_is_the_hard_lift() -> None:
    # The hard protocol takes a tenth of the torsional coefficient where the axis keeps the two in proportion.
    around = models((FRICTION[0], FRICTION[1] * HARD[1] / HARD[0]))
    found = [around.lift(MANY, row, WHERE, Variant(friction=HARD[0])) for row in range(len(MANY))]
    hard = validate_lifts(HAND, BOX, MANY, WHERE, hard=True, pieces=WHOLE)
    assert [rollout.outcome for rollout in found] == hard.outcome.tolist()
    assert [rollout.margin for rollout in found] == hard.margin.tolist()
    plain = validate_lifts(HAND, BOX, MANY, WHERE, pieces=WHOLE)
    assert 0 < hard.success.sum() < plain.success.sum()


def test_only_what_lifts_is_asked_and_the_first_eight_of_sixteen_models_are_those_of_eight() -> None:
    few = MANY.take(np.array([0, 3]))
    where = WHERE.take(slice(0, 2))
    held = validate_lifts(HAND, BOX, few, where, pieces=WHOLE).success
    assert held.tolist() == [0, 1]
    sixteen, eight = (robust(HAND, BOX, few, held=held, placed=where, models=k, pieces=WHOLE, seed=2) for k in (16, 8))
    assert np.array_equal(sixteen.held[:, :8], eight.held) and np.array_equal(sixteen.axis[:, :8], eight.axis)
    assert np.isnan(eight.share[0]) and (eight.held[0] == -1).all() and eight.weakest[0] == Axis.NONE
    assert (eight.held[1:] >= 0).all()


@pytest.mark.parametrize("wanted", [0.25, 0.75, 0.9])
def test_lifts_that_end_early_say_of_the_wanted_share_what_all_of_them_say(
    monkeypatch: pytest.MonkeyPatch, wanted: float
) -> None:
    by_luck(monkeypatch)
    whole, early = (robust(HAND, BOX, MANY, placed=WHERE, pieces=WHOLE, wanted=one) for one in (0.0, wanted))
    assert ((early.share >= wanted - 1e-9) == (whole.share >= wanted - 1e-9)).all()
    validated = early.held >= 0
    assert (early.held[validated] == whole.held[validated]).all()
    assert validated.sum() < whole.held.size


def test_a_heavier_object_weighs_more_and_takes_more_to_lift() -> None:
    test = VariantLift(models().scene(Variant(mass=2.0)), PLACED, Variant(mass=2.0), None)
    test._begin(MANY, 0)
    assert test.data.xfrc_applied[test.scene.object_body, :3] == pytest.approx(
        2.0 * test.scene.push * np.array([0, 0, 1.0])
    )
    lifted = [models().lift(MANY, 2, WHERE, Variant(mass=mass)).success for mass in (1.0, 2.0)]
    assert lifted == [True, False]


def test_an_object_that_stands_off_slides_on_its_table_and_the_hand_stays_over_that() -> None:
    up = WHERE.scenes[0].up
    variant = upright(Variant(object_shift_m=(0.001, -0.0015, 0.0005), object_turn=(0.01, 0.0, 0.02)), up)
    assert np.array(variant.object_shift_m) @ up == pytest.approx(0.0, abs=1e-12)
    assert variant.object_shift_m[:2] == (0.001, -0.0015)
    assert np.cross(variant.object_turn, up) == pytest.approx([0, 0, 0], abs=1e-12)
    assert np.linalg.norm(variant.object_turn) == pytest.approx(0.02)
    one, motion = seen(BOX, MANY, 5, variant), motion_of(BOX, variant)
    assert one.approach is not None and MANY.approach is not None
    # Hand, seen from where the object stands, and from where it was thought to be: the same place in the world.
    for now, thought in (
        (one.pregrasp.hand_pose[0], MANY.pregrasp.hand_pose[5]),
        (one.approach[0, 0], MANY.approach[5, 0]),
    ):
        assert motion[:3] + quat_rotate(motion[3:], now[:3]) == pytest.approx(thought[:3], abs=1e-12)
    turn = quat_from_axis_angle(up, np.array(0.02 * np.sign(np.array(variant.object_turn) @ up)))
    assert abs(float(motion[3:] @ turn)) == pytest.approx(1.0)
    assert models().lift(MANY, 5, WHERE, variant).success


def test_fingers_of_a_lift_close_one_after_another_too() -> None:
    variant = Variant(lags=(0.0, 0.25))
    test = VariantLift(models().scene(variant), PLACED, variant, models()._lags(variant))
    start = MANY.pregrasp.joint_positions[5]
    way = [joints for _, joints in test._way(MANY, 5)]
    assert len(way) == 2 * STAGES
    assert way[4][1] == pytest.approx(start[1]) and way[4][0] > start[0]
    assert way[-1] == pytest.approx(MANY.squeeze.joint_positions[5])


def test_neighbours_stand_beside_the_object_in_every_model() -> None:
    placed = beside((0.0, 0.1), (0.03, 0.03, 0.05)).placed
    around = Models(HAND, BOX, WHOLE, MujocoOptions(), placed.supports, placed.neighbours)
    assert all(around.scene(one).neighbours for one in (NOMINAL, Variant(grown_m=1e-3), Variant(centre_m=(0, 1e-3, 0))))
    found = around.lift(grasp(0.05), 0, placed, Variant(object_shift_m=(0.001, 0, 0)))
    assert found.outcome is LiftOutcome.LIFTED


def test_a_lift_needs_a_scene_and_a_way_of_each_grasp() -> None:
    without = dataclasses.replace(MANY, approach=None)
    for grasps, where, level in (
        (MANY, WHERE.take(slice(0, 2)), "lift"),
        (without, WHERE, "lift"),
        (MANY, WHERE, "no"),
    ):
        with pytest.raises(InputError):
            robust(HAND, BOX, grasps, placed=where, level=level, pieces=WHOLE)  # type: ignore[arg-type]
