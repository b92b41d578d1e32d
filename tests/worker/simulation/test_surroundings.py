"""Obstacles against closed forms, and against MuJoCo's distances."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from graspd.service.model.errors import InputError
from graspd.service.model.transforms import apply, quat_rotate
from graspd.worker.grasps import Posture
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.simulation.environment import CLEAR_M, Environment, Obstacle, PlacedGrasps
from graspd.worker.simulation.obstacles import (
    PosedFeatures,
    body_distances,
    body_room,
    obstacle_distances,
    obstacle_room,
)

TILTED = np.array([0.1, -0.2, 0.3, 0.8, 0.2, -0.4, 0.4]) / [1, 1, 1, 1, 1, 1, 1]
TILTED[3:] /= np.linalg.norm(TILTED[3:])


def test_the_distance_from_a_half_space_is_the_height_above_it() -> None:
    plane = Obstacle.half_space([0, 0, 2], 0.5)
    np.testing.assert_allclose(plane.distance(np.array([[1, 2, 3], [0, 0, 0.1]])), [2.75, -0.15], atol=1e-12)


def test_the_distance_from_a_box_is_exact_inside_and_over_its_faces() -> None:
    box = Obstacle.box([0, 0, 0, 1, 0, 0, 0], [0.2, 0.4, 0.6])
    points = np.array([[0.15, 0, 0], [0, -0.3, 0.1], [0, 0, 0.25], [0.09, 0, 0]])
    np.testing.assert_allclose(box.distance(points), [0.05, 0.1, -0.05, -0.01], atol=1e-12)


def test_beyond_an_edge_the_distance_is_never_more_than_the_true_one() -> None:
    box = Obstacle.box([0, 0, 0, 1, 0, 0, 0], [0.2, 0.2, 0.2])
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (500, 3))
    outside = np.maximum(np.abs(points) - 0.1, 0.0)
    true = np.linalg.norm(outside, axis=1)
    assert (box.distance(points)[true > 0] <= true[true > 0] + 1e-12).all()


def test_an_obstacle_seen_from_a_frame_has_the_same_distances_there() -> None:
    points = np.random.default_rng(1).normal(size=(50, 3))
    for obstacle in (Obstacle.half_space([1, 2, 3], 0.4), Obstacle.box(TILTED, [0.3, 0.5, 0.7])):
        np.testing.assert_allclose(
            obstacle.seen_from(TILTED).distance(points), obstacle.distance(apply(TILTED, points)), atol=1e-12
        )


def test_up_is_against_gravity_in_the_object_frame() -> None:
    placed = PlacedGrasps((Obstacle.half_space([0, 0, 1], 0),), TILTED[None], np.zeros(1, int))
    np.testing.assert_allclose(quat_rotate(TILTED[3:], placed.scenes[0].up), [0, 0, 1], atol=1e-12)


@pytest.mark.parametrize(
    "make",
    [
        lambda: Obstacle.half_space([0, 0, 0], 1.0),
        lambda: Obstacle.half_space([0, 0, float("nan")], 1.0),
        lambda: Obstacle.box([0, 0, 0, 1, 0, 0, 0], [1, 0, 1]),
        lambda: Obstacle.box([0, 0, 0, 0, 0, 0, 0], [1, 1, 1]),
        lambda: Obstacle.box([0, 0, 0], [1, 1, 1]),
    ],
)
def test_nonsense_is_refused(make) -> None:
    with pytest.raises(InputError):
        make()


@pytest.mark.parametrize("name", ["allegro", "barrett", "shadow"])
def test_the_distance_of_a_hand_from_a_plane_is_mujocos(name: str) -> None:
    """1e-5 m: MuJoCo keeps meshes in float32 and its distances converge to 1e-6."""
    hand, rng = hand_from_path(name), np.random.default_rng(3)
    q = hand.lower + rng.random((8, hand.dofs)) * (hand.upper - hand.lower)
    rotation = rng.normal(size=(8, 4))
    pose = np.concatenate(
        [rng.normal(size=(8, 3)) * 0.1, rotation / np.linalg.norm(rotation, axis=1, keepdims=True)], 1
    )
    postures = Posture(pose, hand.expand(q))
    plane = Obstacle.half_space([0.3, -0.5, 0.8], -0.2)
    found = obstacle_distances(hand, postures, Environment((plane,), plane.planes[0, :3]))
    np.testing.assert_allclose(found, mujoco_distances(hand, postures, plane), atol=1e-5)


def test_fingertips_have_more_room_over_what_they_may_touch_and_nothing_else_has() -> None:
    hand = hand_from_path("barrett")
    posture = Posture(np.array([[0, 0, 0, 1.0, 0, 0, 0]]), hand.expand(hand.preshape[None]))
    table, wall = Obstacle.half_space([0, 0, 1], -0.3), Obstacle.half_space([1, 0, 0], -0.4)
    up = np.array([0.0, 0, 1])
    tips = np.isin(np.arange(hand.bodies), hand.fingertips)
    alone, beside = (body_distances(hand, posture, Environment((one,), up))[0] for one in (table, wall))
    to_touch = replace(table, tips_m=-0.0005)
    found = body_room(hand, posture, [Environment((to_touch, wall), up)])[0]
    np.testing.assert_array_equal(found, np.minimum(alone + np.where(tips, 0.0025, 0.0), beside))
    assert obstacle_room(hand, posture, [Environment((to_touch, wall), up)])[0] == found.min()
    pose = np.array([0.1, 0, 0, 0.6, 0, 0.8, 0])
    assert to_touch.seen_from(pose).tips_m == -0.0005, "a support keeps what it says wherever it is seen from"


@pytest.mark.parametrize("name", ["allegro", "barrett", "shadow"])
def test_many_hands_have_the_room_of_each_ones_scene(name: str) -> None:
    """Against NumPy's features; both in double precision."""
    hand, rng = hand_from_path(name), np.random.default_rng(4)
    turned = rng.normal(size=(9, 4))
    pose = np.column_stack([rng.normal(size=(9, 3)) * 0.1, turned / np.linalg.norm(turned, axis=1, keepdims=True)])
    postures = Posture(pose, hand.expand(rng.uniform(hand.lower, hand.upper, (9, hand.dofs))))
    one, other = Obstacle.half_space([0.3, -0.5, 0.8], -0.1), Obstacle.half_space([0, 1, 0], 0.05)
    up, which = np.array([0.0, 0, 1]), np.arange(9) % 3
    scenes = [Environment((one,), up), Environment((one, other), up), Environment((), up)]
    posed = PosedFeatures.of(hand, postures)
    wanted = np.full(9, np.inf)
    for number, around in enumerate([[one], [one, other], []]):
        for obstacle in around:
            wanted[which == number] = np.minimum(wanted, posed.distance(obstacle).min(axis=1))[which == number]
    np.testing.assert_allclose(obstacle_room(hand, postures, scenes, which), wanted, atol=1e-12)


def parted(hand: HandModel) -> tuple[HandModel, HandModel]:
    """The hand's fingertips alone, and the rest of it."""
    tip = [piece.body in hand.fingertips for piece in hand.pieces]
    return tuple(
        replace(hand, pieces=tuple(p for p, is_tip in zip(hand.pieces, tip, strict=True) if is_tip == wanted))
        for wanted in (True, False)
    )


def mujoco_room(hand, postures: Posture, obstacle: Obstacle) -> np.ndarray:
    """As `obstacle_room` has it, by MuJoCo's distances."""
    if obstacle.tips_m is None:
        return mujoco_distances(hand, postures, obstacle)
    tips, rest = parted(hand)
    over = mujoco_distances(tips, postures, obstacle) + CLEAR_M - obstacle.tips_m
    return np.minimum(mujoco_distances(rest, postures, obstacle), over)


def mujoco_distances(hand, postures: Posture, obstacle: Obstacle) -> np.ndarray:
    from graspd.worker.scenes.neighbours import _add_piece

    spec = mujoco.MjSpec()
    if len(obstacle.corners):
        spec.add_mesh(name="obstacle", uservert=obstacle.corners.ravel())
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="obstacle")
    else:
        geom = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.1])
        normal, offset = obstacle.planes[0, :3], obstacle.planes[0, 3]
        geom.pos = offset * normal
        mujoco.mju_quatZ2Vec(geom.quat, normal)
    for k, one in enumerate(hand.pieces):
        _add_piece(spec, spec.worldbody.add_body(mocap=True), f"p{k}", one)
    model = spec.compile()
    data = mujoco.MjData(model)
    bodies = body_poses(hand, postures.hand_pose, postures.joint_positions)
    least = []
    for row in bodies:
        placed = row[[one.body for one in hand.pieces]]
        data.mocap_pos[:], data.mocap_quat[:] = placed[:, :3], placed[:, 3:]
        mujoco.mj_kinematics(model, data)
        least.append(min(mujoco.mj_geomDistance(model, data, 0, k + 1, 10.0, None) for k in range(len(hand.pieces))))
    return np.array(least)
