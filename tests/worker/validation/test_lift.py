"""The lift test on a gripper of two plates and a box that stands on a table."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import trimesh

from graspd.service.model.matter import ACCELERATION
from graspd.service.model.transforms import quat_multiply, quat_rotate
from graspd.worker.grasps import GraspSet, Posture
from graspd.worker.simulation.environment import Neighbour, Obstacle, PlacedGrasps
from graspd.worker.simulation.obstacles import obstacle_distances
from graspd.worker.validation.decomposition import ConvexPieces
from graspd.worker.validation.lift import RISING, RISING_S, Lift, LiftOutcome
from graspd.worker.validation.lifting import lift_key
from graspd.worker.validation.model import MujocoOptions, build
from tests.worker.models import object_from_mesh
from tests.worker.quality.helpers import pad_hand, posture

HALF, HEIGHT = 0.03, 0.05
HAND = pad_hand()
BOX = object_from_mesh(trimesh.creation.box((2 * HALF, 0.04, HEIGHT)))
WHOLE = ConvexPieces((BOX.hull_vertices,), 1.0, 0.0, "box")
#: The hand's base is at -z of the object: the box stands on its head, so that the hand comes from above.
PLACED = PlacedGrasps(
    (Obstacle.half_space([0, 0, 1], 0.0),), np.array([[0, 0, HEIGHT / 2, 0, 1, 0, 0.0]]), np.zeros(1, int)
)
#: Joint value at which the pads touch.
TOUCH = 0.065


def grasp(squeeze: float, way: np.ndarray | None = None) -> GraspSet:
    """Pads 5 mm open, in touch, then commanded `squeeze` [m] past the touch; the hand comes straight from above."""
    open_, touch, press = (posture(((0.0, 0.0, 0.0), (q, q))) for q in (TOUCH - 0.005, TOUCH, TOUCH + squeeze))
    approach = np.repeat(open_.hand_pose[:, None], 6, axis=1)
    approach[..., :3] += np.linspace(0.1, 0, 6)[:, None] * (np.array([0, 0, -1.0]) if way is None else way)
    raised = press.hand_pose - np.array([0, 0, 0.1, 0, 0, 0, 0])
    lift = Posture(raised, press.joint_positions)
    return dataclasses.replace(
        GraspSet(touch, open_, press, np.full(1, np.nan)), approach=approach, coming=open_.joint_positions, lift=lift
    )


def lift_test(physics: MujocoOptions | None = None) -> Lift:
    return Lift(build(HAND, BOX, WHOLE, physics or MujocoOptions(), PLACED.supports), PLACED)


@pytest.mark.parametrize("level", ["dexgraspbench", "lift"])
def test_a_firm_squeeze_lifts_the_box(level: str) -> None:
    rollout = getattr(lift_test(), level)(grasp(0.05), 0)
    assert rollout.outcome is LiftOutcome.LIFTED
    assert rollout.margin < 0.5


@pytest.mark.parametrize("level", ["dexgraspbench", "lift"])
def test_without_a_squeeze_the_box_stays(level: str) -> None:
    rollout = getattr(lift_test(), level)(grasp(-0.005), 0)
    assert rollout.outcome is LiftOutcome.NOT_LIFTED


def test_glue_lifts_what_the_same_squeeze_does_not_hold() -> None:
    weak = grasp(0.0005)
    assert lift_test(MujocoOptions(friction=(0.05, 0.001))).lift(weak, 0).outcome is LiftOutcome.NOT_LIFTED
    assert lift_test(MujocoOptions(friction=(50.0, 1.0))).lift(weak, 0).outcome is LiftOutcome.LIFTED


def test_a_lift_ends_where_its_object_is_lost() -> None:
    lost, held = lift_test().lift(grasp(-0.01), 0), lift_test().lift(grasp(0.05), 0)
    # Half of the rise takes the hand 5 cm away from a box that stays.
    rise = RISING * RISING_S / MujocoOptions().timestep
    assert lost.steps < held.steps - 0.3 * rise


def test_a_slippery_table_changes_nothing_once_the_box_is_lifted() -> None:
    test = lift_test()
    rough = test.lift(grasp(0.05), 0)
    model = test.scene.model
    model.geom_priority[test.scene.support_geoms] = 1
    model.geom_friction[test.scene.support_geoms] = 1e-6
    smooth = test.lift(grasp(0.05), 0)
    assert smooth.outcome is rough.outcome is LiftOutcome.LIFTED
    assert smooth.margin == pytest.approx(rough.margin, abs=0.05)


def test_a_hand_that_comes_through_the_box_has_touched_it() -> None:
    assert lift_test().lift(grasp(0.05, np.array([1.0, 0, 0])), 0).outcome is LiftOutcome.TOUCHED_ON_THE_WAY


def test_a_hand_that_comes_from_below_has_touched_the_table() -> None:
    assert lift_test().lift(grasp(0.05, np.array([0, 0, 1.0])), 0).outcome is LiftOutcome.TOUCHED_ON_THE_WAY


@pytest.mark.parametrize(("tips_m", "touched"), [(None, True), (0.0, True), (-0.0005, True), (-0.001, False)])
def test_fingertips_press_into_the_table_as_deep_as_it_says_and_no_deeper(tips_m: float | None, touched: bool) -> None:
    """A way that ends with the pads 0.8 mm in the table."""
    placed = PlacedGrasps((dataclasses.replace(PLACED.supports[0], tips_m=tips_m),), PLACED.object_pose, PLACED.index)
    given = grasp(0.05)
    down = obstacle_distances(HAND, given.grasp, placed.scenes[0])[0] + 0.0008
    assert given.approach is not None
    for part in (given.grasp.hand_pose, given.pregrasp.hand_pose, given.squeeze.hand_pose, given.approach[0]):
        part[:, 2] += down
    found = Lift(build(HAND, BOX, WHOLE, MujocoOptions(), placed.supports), placed).lift(given, 0)
    assert (found.outcome is LiftOutcome.TOUCHED_ON_THE_WAY) == touched


def test_the_letter_does_not_look_at_the_way() -> None:
    assert lift_test().dexgraspbench(grasp(0.05, np.array([1.0, 0, 0])), 0).outcome is LiftOutcome.LIFTED


def test_two_lifts_of_one_grasp_say_the_same() -> None:
    test = lift_test()
    first, second = test.lift(grasp(0.05), 0), test.lift(grasp(0.05), 0)
    assert first == second


def test_a_box_whose_mesh_has_its_origin_elsewhere_stands_still_and_is_lifted_alike() -> None:
    away = np.array([0.02, 0.01, HEIGHT])
    box = object_from_mesh(
        trimesh.creation.box((2 * HALF, 0.04, HEIGHT), trimesh.transformations.translation_matrix(away))
    )
    pose = PLACED.object_pose.copy()
    pose[:, :3] -= quat_rotate(pose[:, 3:], away)
    placed = PlacedGrasps(PLACED.supports, pose, PLACED.index)
    scene = build(HAND, box, ConvexPieces((box.hull_vertices,), 1.0, 0.0, "box"), MujocoOptions(), placed.supports)
    test, given = Lift(scene, placed), grasp(0.05)
    for part in (given.grasp, given.pregrasp, given.squeeze, given.lift):
        assert part is not None
        part.hand_pose[:, :3] += away
    assert given.approach is not None
    given.approach[..., :3] += away
    # Where the object is follows its mesh's origin, which a turn moves more where it is farther from the centre.
    assert test.lift(given, 0).margin == pytest.approx(lift_test().lift(grasp(0.05), 0).margin, abs=0.02)
    # Nobody near: what stands on a table keeps standing for a second. A contact gives by 0.1 mm.
    test._begin(given, 0)
    test._put(given.grasp.hand_pose[0] - [0, 0, 1, 0, 0, 0, 0], given.coming[0])
    test._run(1.0)
    moved, turned = test._motion()
    assert moved < 5e-4 and turned < 1e-3


def beside(place: tuple[float, float], size: tuple[float, float, float], mass: float = 0.1) -> Lift:
    """The test with a neighbour that stands on the table at `place`, as seen from the box's middle."""
    other = object_from_mesh(trimesh.creation.box(size)).weighing(mass=mass)
    neighbour = Neighbour(other, (other.hull_vertices,), (), 0.0)
    pose = np.array([[[*place, size[2] / 2, 1.0, 0, 0, 0]]])
    placed = dataclasses.replace(PLACED, neighbours=(neighbour,), neighbour_pose=pose)
    return Lift(build(HAND, BOX, WHOLE, MujocoOptions(), placed.supports, placed.neighbours), placed)


def test_a_neighbour_that_stands_aside_changes_nothing() -> None:
    rollout = beside((0.0, 0.3), (0.05, 0.05, 0.1)).lift(grasp(0.05), 0)
    assert rollout.outcome is LiftOutcome.LIFTED
    assert rollout.margin == pytest.approx(lift_test().lift(grasp(0.05), 0).margin, abs=0.02)


def test_a_hand_that_comes_through_a_neighbour_has_touched_it() -> None:
    coming = grasp(0.05, np.array([0, 1.0, 0]))
    size = (0.2, 0.02, 0.2)
    assert beside((0.0, -0.09), size).lift(coming, 0).outcome is LiftOutcome.TOUCHED_ON_THE_WAY
    assert beside((0.0, 0.09), size).lift(coming, 0).outcome is LiftOutcome.LIFTED


def test_a_neighbour_has_its_own_mass_which_moves_the_key_of_lifts() -> None:
    light, heavy = (beside((0.0, 0.3), (0.05, 0.05, 0.1), mass) for mass in (0.05, 2.0))
    for test, mass in ((light, 0.05), (heavy, 2.0)):
        test._begin(grasp(0.05), 0)
        (free,) = test.scene.neighbours
        assert free.mass == pytest.approx(mass)
        assert np.linalg.norm(test.data.xfrc_applied[free.body]) == pytest.approx(ACCELERATION * mass)
    keys = [lift_key(HAND, BOX, test.placed, "lift", False, pieces=WHOLE) for test in (light, heavy)]
    assert keys[0] != keys[1]


def test_a_neighbour_that_leans_has_toppled() -> None:
    test = beside((0.0, 0.3), (0.05, 0.05, 0.1))
    test._begin(grasp(0.05), 0)
    free = test.scene.neighbours[0]
    turned = np.array([np.cos(np.radians(8)), np.sin(np.radians(8)), 0, 0])
    test.data.qpos[free.qpos + 3 : free.qpos + 7] = quat_multiply(test._beside[0][3:], turned)
    assert test._neighbours_moved()


def test_a_neighbour_may_turn_where_it_stands() -> None:
    test = beside((0.0, 0.3), (0.05, 0.05, 0.1))
    test._begin(grasp(0.05), 0)
    free = test.scene.neighbours[0]
    about = np.array([np.cos(0.5), 0, 0, np.sin(0.5)])
    test.data.qpos[free.qpos + 3 : free.qpos + 7] = quat_multiply(test._beside[0][3:], about)
    assert not test._neighbours_moved()
    test.data.qpos[free.qpos] += 0.021
    assert test._neighbours_moved()
