"""Models of the engine that are kept, and shortcuts around the simulation that move no bit of a verdict."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import trimesh

from graspd.worker.grasps import Posture
from graspd.worker.simulation.environment import Obstacle
from graspd.worker.validation.compiled import scene_of
from graspd.worker.validation.decomposition import ConvexPieces
from graspd.worker.validation.displacement import simulated_displacement_cm
from graspd.worker.validation.model import MujocoOptions, build
from graspd.worker.validation.protocol import Rollout, Test
from graspd.worker.validation.validator import validate
from tests.worker.models import object_from_mesh
from tests.worker.quality.helpers import grasp_set, pad_hand, plate_hand, posture

BOX = object_from_mesh(trimesh.creation.box((0.06, 0.04, 0.05)))
WHOLE = ConvexPieces((BOX.hull_vertices,), 1.0, 0.0, "box")
PADS, PLATES = pad_hand(), plate_hand()
TABLE = Obstacle.half_space((0, 0, 1), -0.3)


def test_the_same_pair_is_compiled_once() -> None:
    again = replace(BOX, name="another name")
    assert scene_of(PADS, BOX, WHOLE, MujocoOptions()) is scene_of(PADS, again, WHOLE, MujocoOptions())
    assert scene_of(PADS, BOX, WHOLE, MujocoOptions(), [TABLE]) is scene_of(PADS, BOX, WHOLE, MujocoOptions(), [TABLE])


@pytest.mark.parametrize(
    "other",
    [
        (PLATES, BOX, WHOLE, MujocoOptions()),
        (PADS, replace(BOX, inertia=2 * BOX.inertia), WHOLE, MujocoOptions()),
        (PADS, BOX, ConvexPieces((1.01 * BOX.hull_vertices,), 1.0, 0.0, "box"), MujocoOptions()),
        (PADS, BOX, WHOLE, MujocoOptions().hardened()),
        (PADS, BOX, WHOLE, MujocoOptions(), [TABLE]),
    ],
)
def test_whatever_moves_a_verdict_gives_another_model(other: tuple) -> None:
    assert scene_of(*other) is not scene_of(PADS, BOX, WHOLE, MujocoOptions())


class Whole(Test):
    """Depths after a whole forward pass, forces and accelerations with it."""

    def _depths(self, posture: Posture, row: int) -> tuple[float, float]:
        self._put(posture.hand_pose[row], posture.joint_positions[row])
        mujoco.mj_forward(self.scene.model, self.data)
        return self.penetration()


def told(rollouts: list[Rollout]) -> list[tuple[object, ...]]:
    return [(t.outcomes, t.margin, t.penetration_m, t.self_penetration_m, t.steps) for t in rollouts]


@pytest.mark.parametrize("hand", [PADS, PLATES])
def test_trials_in_kept_models_are_those_of_fresh_ones_bit_for_bit(hand: object) -> None:
    rows = [((0, 0, z), (gap, gap)) for z in np.linspace(0.0, 0.055, 4) for gap in (0.0655, 0.071)]
    grasps = grasp_set(posture(*rows))
    fresh = Whole(build(hand, BOX, WHOLE, MujocoOptions()))  # type: ignore[arg-type]
    wanted = told([fresh.standard(grasps, row) for row in range(len(grasps))])
    scene = scene_of(hand, BOX, WHOLE, MujocoOptions())  # type: ignore[arg-type]
    for _ in range(2):
        kept = Test(scene)
        assert told([kept.standard(grasps, row) for row in range(len(grasps))]) == wanted
    assert max(t[2] for t in wanted) > 0.0, "some of them reach into the box"  # type: ignore[operator, type-var]


def test_verdicts_and_displacements_are_the_same_when_asked_again() -> None:
    grasps = grasp_set(posture(*[((0, 0, z), (0.066, 0.066)) for z in (0.0, 0.02, 0.05)]))
    first, second = (validate(PADS, BOX, grasps, pieces=WHOLE) for _ in range(2))
    assert np.array_equal(first.outcome, second.outcome) and np.array_equal(first.margin, second.margin)
    way = [simulated_displacement_cm(PADS, BOX, grasps.grasp, pieces=WHOLE) for _ in range(2)]
    assert np.array_equal(*way)
