"""The short lift against Coulomb's law and the lift test, on a gripper of two pads and a box on a table."""

from __future__ import annotations

import numpy as np
import pytest

from tests.worker.quality.test_lift import BOX, HAND, PLACED, WHOLE, grasp
from worker.grasps import GraspSet, joined
from worker.quality.referee.model import OBJECT_MASS
from worker.quality.referee.protocol import MAX_DISPLACEMENT_M, STAGE_S
from worker.quality.referee.short import DEEP, HANGING, PHYSICS, PULL, SLIPS, ShortLifts
from worker.simulation.surroundings import Placed

#: Squeeze [m] whose two normal forces F = kp d hold the pull by friction: 2 mu F = PULL.
LEAST = PULL / (2 * PHYSICS.friction[0]) / float(HAND.stiffness[0])


def scores(*squeezes: float, threads: int = 1) -> np.ndarray:
    placed = Placed(PLACED.supports, PLACED.object_pose, np.zeros(len(squeezes), int))
    grasps: GraspSet = joined([grasp(squeeze) for squeeze in squeezes])
    return ShortLifts(HAND, BOX, lambda: WHOLE, threads=threads).scores(grasps, placed)


def fallen(hold: float) -> float:
    """Score of a box of 0.1 kg that slips out of friction `hold` [N] from rest: how far it falls, over 5 cm."""
    seconds = round(STAGE_S / PHYSICS.timestep) * PHYSICS.timestep * HANGING
    return 0.5 * (PULL - hold) / OBJECT_MASS * seconds**2 / MAX_DISPLACEMENT_M


def test_the_box_falls_by_what_friction_does_not_carry() -> None:
    nobody, weak, firm = np.subtract(scores(-0.005, 0.9 * LEAST, 1.05 * LEAST), SLIPS)
    assert nobody == pytest.approx(fallen(0.0), rel=0.05)
    # Pads and their drives give: what remains of the pull is off by a tenth of the force that should hold it.
    assert fallen(0.95 * PULL) < weak < fallen(0.85 * PULL)
    assert 0.0 <= firm < 0.05


def test_what_holds_at_half_the_friction_needs_twice_the_squeeze() -> None:
    slips, holds = scores(1.1 * LEAST, 2.4 * LEAST)
    assert SLIPS <= slips < SLIPS + 0.05
    assert holds < 0.05


def test_a_hand_comes_unless_something_is_in_its_way() -> None:
    aside = grasp(0.05, way=np.array([1.0, 0, 0]))
    both = joined([grasp(0.05), aside])
    placed = Placed(PLACED.supports, PLACED.object_pose, np.zeros(2, int))
    assert ShortLifts(HAND, BOX, lambda: WHOLE).come(both, placed).tolist() == [True, False]


def test_pads_that_start_in_the_box_are_no_candidates() -> None:
    deep = grasp(0.05)
    deep.pregrasp.joint_positions[:] += 0.02
    placed = Placed(PLACED.supports, PLACED.object_pose, np.zeros(1, int))
    assert ShortLifts(HAND, BOX, lambda: WHOLE).scores(deep, placed) == [DEEP]


def test_threads_and_the_other_grasps_change_no_score() -> None:
    squeezes = (0.02, -0.005, 0.05)
    assert np.array_equal(scores(*squeezes, threads=3), scores(*squeezes))
    assert np.array_equal(scores(*squeezes)[1:2], scores(squeezes[1]))
