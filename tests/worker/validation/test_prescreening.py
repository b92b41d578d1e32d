"""The short lift and the short pushes against Coulomb's law, on a gripper of two pads and a box."""

from __future__ import annotations

import numpy as np
import pytest

from graspd.service.model.matter import ACCELERATION
from graspd.worker.grasps import GraspSet, joined
from graspd.worker.simulation.environment import PlacedGrasps
from graspd.worker.validation.prescreening import (
    DEEP,
    GONE,
    HANGS,
    HANGS_WHOLE,
    PHYSICS,
    PULL,
    PUSHED,
    SLIPS,
    LiftRollouts,
    push_rollout,
)
from graspd.worker.validation.protocol import MAX_DISPLACEMENT_M, STAGE_S
from tests.worker.validation.test_lift import BOX, HAND, PLACED, WHOLE, grasp

#: Squeeze [m] whose two normal forces F = kp d hold a pull of 1 N by friction: 2 mu F = 1 N; the same for the pulls.
NEWTON = 1 / (2 * PHYSICS.friction[0]) / float(HAND.stiffness[0])
LEAST, LEAST_PUSHED = HANGS_WHOLE * NEWTON, PULL * NEWTON
#: The same of what hangs at half the friction.
LEAST_AT_HALF = 2 * HANGS * NEWTON


def scores(*squeezes: float, threads: int = 1) -> np.ndarray:
    placed = PlacedGrasps(PLACED.supports, PLACED.object_pose, np.zeros(len(squeezes), int))
    grasps: GraspSet = joined([grasp(squeeze) for squeeze in squeezes])
    return LiftRollouts(HAND, BOX, lambda: WHOLE, threads=threads).scores(grasps, placed)


def fallen() -> float:
    """Score of a box that nothing holds: how far it falls from rest until a stage's end finds it gone, over 5 cm."""
    fall = 0.5 * HANGS_WHOLE * ACCELERATION * (STAGE_S * np.arange(1, 10)) ** 2 / MAX_DISPLACEMENT_M
    return float(fall[fall >= GONE][0])


def test_the_box_falls_by_what_friction_does_not_carry() -> None:
    nobody, weak, firm = np.subtract(scores(-0.005, 0.9 * LEAST, 1.05 * LEAST), SLIPS)
    assert nobody == pytest.approx(fallen(), rel=0.05)
    # What slips slowly is less than 5 cm down when the test ends, and would be farther in 2 s.
    assert weak > GONE
    assert 0.0 <= firm < 0.05


def test_what_holds_at_half_the_friction_needs_twice_the_squeeze_for_its_pull() -> None:
    slips, holds = scores(0.9 * LEAST_AT_HALF, 1.1 * LEAST_AT_HALF)
    assert SLIPS <= slips < SLIPS + 0.05
    assert holds < 0.05


def test_what_must_hold_at_half_the_friction_to_be_better_is_not_asked_of_the_whole() -> None:
    placed = PlacedGrasps(PLACED.supports, PLACED.object_pose, np.zeros(3, int))
    grasps = joined([grasp(squeeze) for squeeze in (1.1 * LEAST, 2.4 * LEAST, 1.1 * LEAST)])
    found = LiftRollouts(HAND, BOX, lambda: WHOLE).scores(grasps, placed, np.array([1.5, 1.5, np.inf]))
    assert found[0] == 1.5
    assert found[1] < 0.05
    assert SLIPS <= found[2] < SLIPS + 0.05


def test_pads_that_start_in_the_box_are_no_candidates() -> None:
    deep = grasp(0.05)
    deep.pregrasp.joint_positions[:] += 0.02
    placed = PlacedGrasps(PLACED.supports, PLACED.object_pose, np.zeros(1, int))
    assert LiftRollouts(HAND, BOX, lambda: WHOLE).scores(deep, placed) == [DEEP]


def test_threads_and_the_other_grasps_change_no_score() -> None:
    squeezes = (0.02, -0.005, 0.05)
    assert np.array_equal(scores(*squeezes, threads=3), scores(*squeezes))
    assert np.array_equal(scores(*squeezes)[1:2], scores(squeezes[1]))


#: Of a push towards a corner what two pads must hold by friction, across their normals; the rest one of them carries.
ACROSS = float(np.sqrt(2.0 / 3.0))


def pushed(*squeezes: float, threads: int = 1) -> np.ndarray:
    grasps: GraspSet = joined([grasp(squeeze) for squeeze in squeezes])
    return push_rollout(HAND, BOX, lambda: WHOLE, threads=threads)(grasps, None)


def test_a_free_box_is_pushed_away_the_less_the_firmer_it_is_held() -> None:
    found = pushed(*(np.array([-0.2, 0.3, 0.6, 0.9, 1.2, 2.4]) * ACROSS * LEAST_PUSHED))
    # Pads that hardly touch turn the box as they are brushed: it is lost either way.
    assert (np.diff(found[1:]) < 0).all()
    # Nothing holds it, or less than a third of what is needed: at the whole friction as well.
    assert (found[:2] >= SLIPS + 1.0).all()


def test_a_free_box_hardly_moves_where_friction_carries_the_pushes() -> None:
    # Twice the squeeze that holds at the whole friction holds at half of it; pads and their drives give a little.
    assert pushed(2.4 * ACROSS * LEAST_PUSHED)[0] < 0.2


def test_a_free_box_that_nothing_holds_flies_as_far_as_the_push_takes_it() -> None:
    seconds = round(STAGE_S * PUSHED / PHYSICS.timestep) * PHYSICS.timestep
    freely = 0.5 * PULL * ACCELERATION * seconds**2 / MAX_DISPLACEMENT_M
    # Along the pads' normals they are in its way; it turns where it meets one.
    assert pushed(-0.02)[0] - SLIPS >= 0.95 * ACROSS * freely


def test_pads_that_start_in_a_free_box_are_no_candidates() -> None:
    deep = grasp(0.05)
    deep.pregrasp.joint_positions[:] += 0.02
    assert push_rollout(HAND, BOX, lambda: WHOLE)(deep, None) == [DEEP]


def test_threads_and_the_other_grasps_change_no_score_of_a_push() -> None:
    squeezes = (0.02, -0.005, 0.05)
    assert np.array_equal(pushed(*squeezes, threads=3), pushed(*squeezes))
    assert np.array_equal(pushed(*squeezes)[1:2], pushed(squeezes[1]))
