"""Grasps moved onto a table beside other objects: poses, clearances, the way in."""

import numpy as np
import pytest
import trimesh

from graspd.service.model.errors import InputError
from graspd.service.model.transforms import apply, compose, invert, quat_from_axis_angle
from graspd.worker.grasps import Posture
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.scenes import Neighbours, drop_together, transfer_grasps
from graspd.worker.scenes.clearance import MARGIN_M, Rejection, approach_postures
from graspd.worker.scenes.neighbours import FARTHEST_M, neighbour_clearance
from tests.worker.models import object_from_mesh, two_finger_hand, unit_vectors

HAND = two_finger_hand()
#: Tessellations lie inside round pieces by r (1 - cos(pi / 48)), and a sphere of 642 corners by 0.4 % of r.
TESSELLATION_M = 6e-5
IDENTITY = np.array([[0.0, 0, 0, 1, 0, 0, 0]])
#: MuJoCo stores meshes in float32 and its GJK stops at 1e-6 of the size.
ENGINE_M = 5e-6
DOWN = np.concatenate([[0, 0, 0.25], quat_from_axis_angle(np.array([1.0, 0, 0]), np.asarray(np.pi))])


def postures(rng: np.random.Generator, count: int) -> Posture:
    pose = np.concatenate([rng.uniform(-0.1, 0.3, (count, 3)), unit_vectors(rng, count, 4)], 1)
    return Posture(pose, rng.uniform(-0.3, 1, (count, 2)))


def lowest_vertex(posture: Posture, object_pose: np.ndarray) -> np.ndarray:
    """Lowest corner of all tessellated pieces in the table frame, by brute force."""
    bodies = compose(object_pose, body_poses(HAND, posture.hand_pose, posture.joint_positions))
    return np.min([apply(bodies[:, p.body][:, None], p.vertices)[..., 2].min(axis=1) for p in HAND.pieces], axis=0)


def test_clearance_agrees_with_all_corners_of_all_pieces_on_way():
    rng = np.random.default_rng(0)
    grasp, pregrasp = postures(rng, 5), postures(rng, 5)
    scenes = postures(rng, 3).hand_pose
    found = transfer_grasps(HAND, grasp, pregrasp, scenes)["grasp/table_clearance_m"].reshape(3, 5)
    path = approach_postures(grasp, pregrasp)
    expected = np.array([lowest_vertex(path, scene).reshape(5, -1).min(axis=1) for scene in scenes])
    assert np.all(found <= expected + 1e-12)
    np.testing.assert_allclose(found, expected, atol=TESSELLATION_M)


def test_transferred_poses_are_base_poses_seen_from_the_table():
    rng = np.random.default_rng(1)
    grasp, scenes = postures(rng, 4), postures(rng, 2).hand_pose
    result = transfer_grasps(HAND, grasp, grasp, scenes)
    assert result["grasp/scene_index"].tolist() == [0] * 4 + [1] * 4
    assert result["grasp/base_index"].tolist() == [0, 1, 2, 3] * 2
    back = compose(invert(scenes[result["grasp/scene_index"]]), result["grasp/hand_pose"])
    points = rng.normal(size=(8, 3))
    base = grasp.hand_pose[result["grasp/base_index"]]
    np.testing.assert_allclose(apply(back, points), apply(base, points), atol=1e-12)


@pytest.mark.parametrize(("gap", "valid"), [(MARGIN_M + 1e-6, 1), (MARGIN_M - 1e-6, 0)])
def test_a_grasp_is_valid_from_the_stated_margin_on(gap, valid):
    # Palm up: the lowest point is the bottom of the palm box, 0.03 below the root.
    posture = Posture(np.array([[0, 0, 0.03 + gap, 1, 0, 0, 0]]), np.zeros((1, 2)))
    assert transfer_grasps(HAND, posture, posture, IDENTITY)["grasp/valid"].tolist() == [valid]


def test_a_hand_that_sweeps_through_the_table_is_caught():
    """Fingers point sideways at both ends and straight down half-way."""
    y = np.array([0.0, 1, 0])
    start, end = (np.concatenate([[0, 0, 0.075], quat_from_axis_angle(y, np.asarray(np.pi + a))]) for a in (-1.4, 1.4))
    pregrasp, grasp = Posture(start[None], np.zeros((1, 2))), Posture(end[None], np.zeros((1, 2)))
    at_ends = min(lowest_vertex(p, IDENTITY[0])[0] for p in (pregrasp, grasp))
    result = transfer_grasps(HAND, grasp, pregrasp, IDENTITY)
    assert at_ends > MARGIN_M
    # Pointing straight down the tips reach 0.079 below the root.
    assert result["grasp/table_clearance_m"][0] <= 0.075 - 0.079 and result["grasp/valid"][0] == 0
    assert result["grasp/contact_table_clearance_m"][0] == pytest.approx(lowest_vertex(grasp, IDENTITY[0])[0], abs=1e-4)
    assert result["grasp/rejection"][0] == Rejection.TABLE_ON_APPROACH
    on_table = Posture(np.array([[0, 0, 0.0, 1, 0, 0, 0]]), np.zeros((1, 2)))
    assert transfer_grasps(HAND, on_table, pregrasp, IDENTITY)["grasp/rejection"][0] == Rejection.TABLE_AT_CONTACT


def test_many_grasps_give_what_each_gives_alone():
    rng = np.random.default_rng(2)
    grasp, scenes = postures(rng, 130), postures(rng, 1).hand_pose
    together = transfer_grasps(HAND, grasp, grasp, scenes)["grasp/table_clearance_m"]
    for k in (0, 64, 129):
        one = grasp.take(slice(k, k + 1))
        assert transfer_grasps(HAND, one, one, scenes)["grasp/table_clearance_m"] == pytest.approx(
            together[[k]], abs=1e-12
        )


def test_no_grasps_are_empty_too_many_are_refused() -> None:
    none = Posture(np.zeros((0, 7)), np.zeros((0, 2)))
    result = transfer_grasps(HAND, none, none, IDENTITY)
    assert result["grasp/hand_pose"].shape == (0, 7) and result["grasp/valid"].shape == (0,)
    rng = np.random.default_rng(3)
    with pytest.raises(InputError, match="2 grasps come with 1 pregrasps"):
        transfer_grasps(HAND, postures(rng, 2), postures(rng, 1), IDENTITY)
    with pytest.raises(InputError, match="1 to 8"):
        drop_together(box(0.05, 0.05, 0.05), [box(0.02, 0.02, 0.02)] * 9, count=1, seed=0)


def box(*size: float):
    return object_from_mesh(trimesh.creation.box(size), "box" + "x".join(map(str, size)))


@pytest.mark.parametrize("height", [0.1, 0.18])
def test_clearance_from_a_box_is_the_gap_or_the_depth(height):
    # Tips end 0.25 - 0.079 above the table, over the box below them or in it.
    neighbours = Neighbours([box(0.3, 0.3, height)], np.array([[[0, 0, height / 2, 1.0, 0, 0, 0]]]))
    found = neighbour_clearance(HAND, Posture(DOWN[None], np.zeros((1, 2))), IDENTITY, neighbours)
    assert found[0, 0] == pytest.approx(0.25 - 0.079 - height, abs=ENGINE_M)


def test_clearance_is_a_capped_lower_bound_of_corner_distances():
    rng = np.random.default_rng(0)
    block = box(0.04, 0.05, 0.06)
    posture, poses = postures(rng, 12), np.array([[[0.15, 0.1, 0.03, 1.0, 0, 0, 0]]])
    found = neighbour_clearance(HAND, posture, IDENTITY, Neighbours([block], poses))[0]
    points, _ = trimesh.sample.sample_surface_even(trimesh.Trimesh(block.vertices, block.faces), 800, seed=0)
    surface = apply(poses[0, 0], points)
    bodies = compose(IDENTITY, body_poses(HAND, posture.hand_pose, posture.joint_positions))
    for k in range(12):
        corners = np.concatenate([apply(bodies[k, p.body], p.vertices) for p in HAND.pieces])
        nearest = np.linalg.norm(corners[:, None] - surface, axis=-1).min()
        assert found[k] <= min(nearest, FARTHEST_M) + ENGINE_M
    assert (found == FARTHEST_M).any() and (found < FARTHEST_M).any()


def test_grasp_that_neighbour_blocks_is_rejected_with_the_reason():
    low = np.array([[0, 0, 0.2, *DOWN[3:]]])
    high = np.array([[0, 0, 0.3, *DOWN[3:]]])
    still = np.zeros((1, 2))
    tower = box(0.02, 0.02, 0.15)

    def reason(grasp: np.ndarray, pregrasp: np.ndarray, place: list[float]) -> tuple[int, int]:
        neighbours = Neighbours([tower], np.array([[[*place, 1.0, 0, 0, 0]]]))
        result = transfer_grasps(HAND, Posture(grasp, still), Posture(pregrasp, still), IDENTITY, neighbours)
        return int(result["grasp/rejection"][0]), int(result["grasp/valid"][0])

    assert reason(low, high, [0.3, 0, 0.075]) == (Rejection.NONE, 1)
    assert reason(low, high, [0.04, 0, 0.075]) == (Rejection.NEIGHBOUR_AT_CONTACT, 0)
    # The hand comes from the side, through the tower.
    aside = low + np.array([0.2, 0, 0, 0, 0, 0, 0])
    assert reason(low, aside, [0.12, 0, 0.075]) == (Rejection.NEIGHBOUR_ON_APPROACH, 0)


def test_the_table_comes_before_the_neighbours_among_the_reasons():
    into_table = np.array([[0, 0, 0.05, *DOWN[3:]]])
    tower = Neighbours([box(0.02, 0.02, 0.15)], np.array([[[0.04, 0, 0.075, 1.0, 0, 0, 0]]]))
    posture = Posture(into_table, np.zeros((1, 2)))
    assert transfer_grasps(HAND, posture, posture, IDENTITY, tower)["grasp/rejection"][0] == Rejection.TABLE_AT_CONTACT
