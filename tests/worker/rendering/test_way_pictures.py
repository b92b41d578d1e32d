"""Pictures of grasps on their way: the object is carried, and no wall stands between it and the camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from PIL import Image

from graspd.service.model.scene_spec import Box, HalfSpace
from graspd.service.readers.trajectories import Waypoint
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.rendering.hands import DrawnHand, drawn_bodies
from graspd.worker.rendering.trajectory_pictures import PictureScenes, way_pictures
from tests.worker.models import object_from_mesh, two_finger_hand

HAND = two_finger_hand()
REST = np.array([[0, 0, 0.03, 1.0, 0, 0, 0]])
DOWN = np.array([0, 0, 0.06, 0, 1.0, 0, 0])


@pytest.fixture(scope="module")
def block():
    return object_from_mesh(trimesh.creation.box((0.05, 0.04, 0.06)), "block")


def at(name: str, height: float = 0.0) -> Waypoint:
    """The hand over the block, both raised."""
    rise = np.array([0, 0, height])
    return Waypoint(name, DOWN + np.append(rise, np.zeros(4)), np.full(2, 0.1), rise)


def orange(picture: np.ndarray) -> np.ndarray:
    """Mask of the pixels that show the object: hues between red and yellow."""
    hue, saturation, value = np.moveaxis(np.asarray(Image.fromarray(picture).convert("HSV")).astype(int), -1, 0)
    return (hue > 8) & (hue < 30) & (saturation > 90) & (value > 30)


def test_every_posture_of_every_grasp_is_drawn_from_every_side(block):
    frames = [[at("grasp"), at("lift", 0.1)]] * 2
    drawn = way_pictures(HAND, block, frames, PictureScenes((HalfSpace(),), REST), (48, 36), sides=3, samples=2)
    assert drawn.shape == (2, 3, 2, 36, 48, 3)
    assert all(orange(picture).sum() > 10 for picture in drawn.reshape(-1, 36, 48, 3))


def test_the_lifted_object_is_higher_in_the_picture(block):
    frames = [[at("grasp"), at("lift", 0.1)]]
    (low, high) = way_pictures(HAND, block, frames, PictureScenes((HalfSpace(),), REST), (64, 64), samples=2)[0, 0]
    assert np.argwhere(orange(high))[:, 0].mean() < np.argwhere(orange(low))[:, 0].mean() - 10


def test_the_whole_hand_is_in_the_picture_where_that_is_asked_for(block):
    frames = [[replace(at("", 0.5), carried=np.zeros(3)), at("grasp")]]
    around = PictureScenes((HalfSpace(),), REST)
    near, whole = (way_pictures(HAND, block, frames, around, (48, 48), whole=w, samples=2)[0, 0] for w in (False, True))
    # The camera steps back for the hand that is far above: the block is smaller, and what is drawn ends above the rim.
    assert 0 < orange(whole[1]).sum() < 0.5 * orange(near[1]).sum()
    empty = way_pictures(HAND, block, [frames[0][1:]], around, (48, 48), samples=2)[0, 0, 0]
    assert np.abs(whole[0][:2].astype(int) - empty[0, 0]).max() < 40


@pytest.mark.parametrize("side", [0, 1, 2, 3])
def test_no_wall_stands_between_the_object_and_the_camera(block, side):
    x, y = np.array([(0.1, 0), (0, 0.1), (-0.1, 0), (0, -0.1)])[side]
    size = (0.02, 0.5, 0.5) if x else (0.5, 0.02, 0.5)
    wall = Box(size=size, pose=(x, y, 0.25, 1, 0, 0, 0))
    around = PictureScenes((HalfSpace(), wall), REST)
    free = way_pictures(HAND, block, [[at("grasp")]], PictureScenes((HalfSpace(),), REST), (48, 48), samples=2)[0, 0, 0]
    walled = way_pictures(HAND, block, [[at("grasp")]], around, (48, 48), samples=2)[0, 0, 0]
    assert orange(walled).sum() > 0.5 * orange(free).sum()


def test_a_free_grasp_floats_over_a_floor(block):
    (picture,) = way_pictures(HAND, block, [[at("grasp")]], PictureScenes(), (48, 48), samples=2)[0, 0]
    assert orange(picture).sum() > 20


def test_each_grasp_stands_in_its_own_scene(block):
    turned = np.array([[0, 0, 0.02, np.sqrt(0.5), np.sqrt(0.5), 0, 0]])
    around = PictureScenes((HalfSpace(),), np.concatenate([REST, turned]), np.array([0, 1]))
    first, second = way_pictures(HAND, block, [[at("grasp")]] * 2, around, (48, 48), samples=2)[:, 0, 0]
    alone = way_pictures(HAND, block, [[at("grasp")]], PictureScenes((HalfSpace(),), turned), (48, 48), samples=2)[
        0, 0, 0
    ]
    np.testing.assert_array_equal(second, alone)
    assert (first != second).any()


def test_links_above_the_root_are_drawn_at_the_angles_of_the_wrist(block):
    # A copy of the hand behind its root serves as a forearm with two wrist joints.
    back = np.array([0, 0, -0.12])
    forearm = replace(HAND, pieces=tuple(replace(p, vertices=p.vertices + back) for p in HAND.pieces))
    mounted, around = replace(HAND, mounting=forearm), PictureScenes((HalfSpace(),), REST)

    def picture(hand, wrist) -> np.ndarray:
        where = replace(around, wrist=wrist if wrist is None else np.array([wrist]))
        return way_pictures(hand, block, [[at("grasp")]], where, (48, 48), whole=True, samples=2)[0, 0, 0].astype(int)

    bare, straight, bent = picture(mounted, None), picture(mounted, [0.0, 0.0]), picture(mounted, [0.9, 0.9])
    assert np.array_equal(bare, picture(HAND, None))
    assert (np.abs(straight - bare).max(axis=-1) > 40).sum() > 30
    assert (np.abs(straight - bent).max(axis=-1) > 40).sum() > 5
    drawn = DrawnHand(mounted, np.array([0, -1]), np.stack([DOWN] * 2), np.zeros((2, 2)), np.array([[0.9, 0.9]] * 2))
    own, above = drawn.body_poses(), body_poses(forearm, DOWN[None], np.array([[0.9, 0.9]]))[0]
    assert len(drawn.parts) == own.shape[1] == 2 * len(drawn_bodies(HAND))
    assert own[0, len(drawn_bodies(HAND)) :] == pytest.approx(above[drawn_bodies(forearm)])
    assert (own[1, :, 2] < -10).all()
