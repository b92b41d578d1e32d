"""Several objects on a table: at rest apart, and hands that keep clear of the neighbours."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from graspd.service.model.errors import InputError
from graspd.service.model.transforms import apply, compose, quat_from_axis_angle
from graspd.worker.grasps import Posture
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.scenes import Neighbours, drop_together, transfer
from graspd.worker.scenes.clearance import Rejection
from graspd.worker.scenes.neighbours import FARTHEST_M, neighbour_clearance
from tests.worker.models import object_from_mesh, two_finger_hand
from tests.worker.scenes.test_clearance import postures

HAND = two_finger_hand()
#: MuJoCo stores meshes in float32 and its GJK stops at 1e-6 of the size.
ENGINE_M = 5e-6
DOWN = np.concatenate([[0, 0, 0.25], quat_from_axis_angle(np.array([1.0, 0, 0]), np.asarray(np.pi))])
LEVEL = np.array([[0.0, 0, 0, 1, 0, 0, 0]])


def box(*size: float):
    return object_from_mesh(trimesh.creation.box(size), "box" + "x".join(map(str, size)))


def hulls(objects, poses) -> list[np.ndarray]:
    return [apply(pose, obj.hull_vertices) for obj, pose in zip(objects, poses, strict=True)]


def separated(a: np.ndarray, b: np.ndarray, normals: np.ndarray) -> bool:
    """Whether one of the directions parts the two point sets (separating axis theorem)."""
    return bool(np.any((a @ normals.T).max(axis=0) <= (b @ normals.T).min(axis=0) + 1e-6))


def test_objects_rest_on_the_table_and_apart():
    objects = [box(0.05, 0.06, 0.07), box(0.04, 0.04, 0.12), box(0.03, 0.08, 0.05)]
    result = drop_together(objects[0], objects[1:], count=4, seed=1)
    for s in range(4):
        poses = [result["scene/object_pose"][s], *result["scene/neighbour_pose"][s]]
        placed = hulls(objects, poses)
        for points in placed:
            assert points[:, 2].min() == pytest.approx(0, abs=1e-9)
        for a in range(3):
            for b in range(3):
                if a < b:
                    # Boxes flat on a table are parted by one of their upright faces or not at all.
                    axes = np.concatenate([_axes(poses[a]), _axes(poses[b])])
                    assert separated(placed[a], placed[b], np.concatenate([axes, -axes]))


def _axes(pose: np.ndarray) -> np.ndarray:
    return apply(np.concatenate([np.zeros(3), pose[3:]]), np.eye(3))


def test_the_same_seed_gives_the_same_scenes_and_more_scenes_keep_the_first():
    objects = [box(0.05, 0.06, 0.07), box(0.04, 0.04, 0.12)]
    first, more = (drop_together(objects[0], objects[1:], count=n, seed=3) for n in (2, 3))
    for name, values in first.items():
        np.testing.assert_array_equal(values, more[name][:2])


def test_clearance_from_a_box_is_the_gap_in_closed_form():
    # Tips end 0.25 - 0.079 above the table; the box below them is 0.1 high.
    block = box(0.3, 0.3, 0.1)
    neighbours = Neighbours([block], np.array([[[0, 0, 0.05, 1.0, 0, 0, 0]]]))
    found = neighbour_clearance(HAND, Posture(DOWN[None], np.zeros((1, 2))), LEVEL, neighbours)
    assert found[0, 0] == pytest.approx(0.25 - 0.079 - 0.1, abs=ENGINE_M)


def test_clearance_is_negative_by_the_depth_of_the_overlap():
    block = box(0.3, 0.3, 0.18)
    neighbours = Neighbours([block], np.array([[[0, 0, 0.09, 1.0, 0, 0, 0]]]))
    found = neighbour_clearance(HAND, Posture(DOWN[None], np.zeros((1, 2))), LEVEL, neighbours)
    assert found[0, 0] == pytest.approx(0.25 - 0.079 - 0.18, abs=ENGINE_M)


def test_clearance_is_no_larger_than_any_distance_of_corners_and_capped():
    rng = np.random.default_rng(0)
    block = box(0.04, 0.05, 0.06)
    posture, poses = postures(rng, 12), np.array([[[0.15, 0.1, 0.03, 1.0, 0, 0, 0]]])
    found = neighbour_clearance(HAND, posture, LEVEL, Neighbours([block], poses))[0]
    surface = apply(
        poses[0, 0], trimesh.sample.sample_surface_even(trimesh.Trimesh(block.vertices, block.faces), 800, seed=0)[0]
    )
    bodies = compose(LEVEL, body_poses(HAND, posture.hand_pose, posture.joint_positions))
    for k in range(12):
        corners = np.concatenate([apply(bodies[k, p.body], p.vertices) for p in HAND.pieces])
        nearest = np.linalg.norm(corners[:, None] - surface, axis=-1).min()
        assert found[k] <= min(nearest, FARTHEST_M) + ENGINE_M
    assert (found == FARTHEST_M).any() and (found < FARTHEST_M).any()


def test_a_grasp_that_a_neighbour_blocks_is_rejected_with_the_reason():
    low = np.array([[0, 0, 0.2, *DOWN[3:]]])
    high = np.array([[0, 0, 0.3, *DOWN[3:]]])
    still = np.zeros((1, 2))
    tower = box(0.02, 0.02, 0.15)

    def reason(grasp: np.ndarray, pregrasp: np.ndarray, place: list[float]) -> tuple[int, int]:
        neighbours = Neighbours([tower], np.array([[[*place, 1.0, 0, 0, 0]]]))
        result = transfer(HAND, Posture(grasp, still), Posture(pregrasp, still), LEVEL, neighbours)
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
    assert transfer(HAND, posture, posture, LEVEL, tower)["grasp/rejection"][0] == Rejection.TABLE_AT_CONTACT


def test_too_many_neighbours_are_refused():
    with pytest.raises(InputError, match="1 to 8"):
        drop_together(box(0.05, 0.05, 0.05), [box(0.02, 0.02, 0.02)] * 9, count=1, seed=0)
