"""Distance, normals, occlusion, given cameras, neighbours and the drawn hand, against closed forms."""

from __future__ import annotations

import json

import numpy as np
import pytest
import trimesh

from graspd.service.model.digests import shard_id
from graspd.service.model.domain import JobRequest
from graspd.service.model.errors import InputError
from graspd.service.model.states import Stage
from graspd.service.store.shards import check_columns
from graspd.worker.objects.model import ObjectModel
from graspd.worker.rendering import Extras, render
from graspd.worker.rendering.annotate import parse_channels
from graspd.worker.rendering.cameras import GivenCameras, intrinsics, look_at, read_cameras
from graspd.worker.rendering.hands import DrawnHand
from graspd.worker.scenes import Neighbours
from tests.worker.models import object_from_mesh, two_finger_hand

SIZE = (96, 72)
RADIUS = 0.04
REST = np.array([[0.02, -0.01, RADIUS, 1.0, 0, 0, 0], [0.0, 0.03, RADIUS, 0, 1.0, 0, 0]])
HALF_PRECISION = 5e-4  # normals are stored with 11 bits
#: Interpolated normals of the ball's 20 480 facets; float32 rays.
FACET_NORMAL = 2e-3
DEPTH_M = 1e-4


def shoot(obj: ObjectModel, poses: np.ndarray = REST, **options) -> dict[str, np.ndarray]:
    options = {"views": 2, "stereo": False, "seed": 1, "samples": 2} | options
    return render(obj, poses, width=SIZE[0], height=SIZE[1], **options)


@pytest.fixture(scope="module")
def ball() -> ObjectModel:
    return object_from_mesh(trimesh.creation.icosphere(subdivisions=5, radius=RADIUS), "ball")


@pytest.fixture(scope="module")
def views(ball) -> dict[str, np.ndarray]:
    return shoot(ball, extras=Extras(channels=("distance", "normals", "occlusion")))


def points(views: dict[str, np.ndarray], view: int) -> np.ndarray:
    """(H, W, 3) seen points in the table frame, from depth, K and E alone; nan where nothing is."""
    k, e = views["camera/intrinsics"][view], views["camera/extrinsics"][view]
    x, y = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    depth = np.where(np.isfinite(views["image/depth"][view]), views["image/depth"][view], np.nan)
    local = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(k).T * depth[..., None]
    return (local - e[:3, 3]) @ e[:3, :3]


def test_ray_distance_is_way_from_optical_centre_to_the_point(views):
    for view, e in enumerate(views["camera/extrinsics"]):
        centre = -e[:3, :3].T @ e[:3, 3]
        expected = np.linalg.norm(points(views, view) - centre, axis=-1)
        seen = np.isfinite(views["image/depth"][view])
        assert np.array_equal(np.isinf(views["image/distance"][view]), ~seen)
        np.testing.assert_allclose(views["image/distance"][view][seen], expected[seen], atol=1e-6)


def test_normals_of_a_ball_point_outward_those_of_the_table_up(views):
    for view, scene in enumerate(views["camera/scene_index"]):
        normals = views["image/normals"][view].astype(float)
        segmentation = views["image/segmentation"][view]
        outward = (points(views, view) - REST[scene, :3]) / RADIUS
        on_ball = segmentation == 2
        assert np.abs(normals - outward)[on_ball].max() < HALF_PRECISION + FACET_NORMAL + 2 * DEPTH_M / RADIUS
        on_top = (segmentation == 1) & (np.abs(points(views, view)[..., 2]) < DEPTH_M)
        assert on_top.sum() > 500
        assert np.abs(normals[on_top] - [0, 0, 1]).max() < HALF_PRECISION
        assert not normals[segmentation == 0].any()


def test_extra_channels_change_no_other_dataset(ball, views):
    plain = shoot(ball)
    assert set(views) - set(plain) == {"image/distance", "image/normals", "box/occlusion_ratio"}
    for name, values in plain.items():
        np.testing.assert_array_equal(values, views[name])
    assert check_columns("views", views)["V"] == 4
    assert views["box/occlusion_ratio"].tolist() == [0.0] * 4, "alone on its table it is not occluded"


def test_a_ball_behind_another_is_hidden_as_far_as_discs_overlap(ball):
    """Two equal balls on one line of sight: the nearer covers the farther one, whose disc is smaller."""
    eye, target = np.array([0.5, 0, RADIUS]), np.array([0.0, 0, RADIUS])
    given = GivenCameras(extrinsics=np.stack([look_at(eye, target), look_at(-eye * [1, 1, -1], target)]))
    neighbour = Neighbours([ball], np.array([[[0.12, 0, RADIUS, 1.0, 0, 0, 0]]]))
    extras = Extras(channels=("occlusion",), cameras=given, neighbours=neighbour)
    seen = shoot(ball, np.array([[0, 0, RADIUS, 1.0, 0, 0, 0]]), extras=extras)
    # The second camera looks from the other side: there the object hides its neighbour.
    np.testing.assert_allclose(seen["box/occlusion_ratio"], [1.0, 0.0], atol=1e-6)
    assert 3 in seen["image/segmentation"][0] and 2 not in seen["image/segmentation"][0]
    assert np.isnan(seen["box/bounding_box_2d_tight"][0]).all()


def test_half_a_ball_behind_a_wall_is_half_occluded(ball):
    wall = object_from_mesh(trimesh.creation.box((0.01, 0.4, 0.2)), "wall")
    # The wall's edge lies on the plane through the camera and the ball's centre.
    neighbour = Neighbours([wall], np.array([[[0.1, 0.2, 0.1, 1.0, 0, 0, 0]]]))
    given = GivenCameras(extrinsics=look_at(np.array([0.5, 0, RADIUS]), np.array([0, 0, RADIUS]))[None])
    extras = Extras(channels=("occlusion",), cameras=given, neighbours=neighbour)
    seen = shoot(ball, np.array([[0, 0, RADIUS, 1.0, 0, 0, 0]]), extras=extras)
    # One column of pixels more or less of the disc's eleven across.
    assert seen["box/occlusion_ratio"][0] == pytest.approx(0.5, abs=0.06)
    given = GivenCameras(extrinsics=look_at(np.array([0.5, 0, 0.2]), np.array([1.0, 0, 0.2]))[None])
    outside = shoot(ball, extras=Extras(channels=("occlusion",), cameras=given))
    assert np.isnan(outside["box/occlusion_ratio"]).all(), "an object out of the picture has none"


def test_given_cameras_are_those_of_every_scene(ball):
    k = np.array([[90.0, 0, 40], [0, 95.0, 30], [0, 0, 1]])
    places = np.stack([look_at(np.array(eye), np.array([0, 0, 0.03])) for eye in ([0.4, 0, 0.3], [0, 0.5, 0.2])])
    seen = shoot(ball, views=7, extras=Extras(cameras=GivenCameras(k, places)))
    np.testing.assert_array_equal(seen["camera/extrinsics"], np.concatenate([places, places]))
    np.testing.assert_array_equal(seen["camera/intrinsics"], np.repeat(k[None], 4, axis=0))
    for view, scene in enumerate(seen["camera/scene_index"]):
        away = np.linalg.norm(points(seen, view) - REST[scene, :3], axis=-1)[seen["image/segmentation"][view] == 2]
        assert len(away) > 100
        # A ray that grazes the facets errs more along itself; they lie at most 8 um inside the ball.
        assert np.abs(away - RADIUS).max() < DEPTH_M


def test_cameras_keep_object_in_a_narrow_field_or_are_refused(ball) -> None:
    k = intrinsics(*SIZE, field_of_view=np.radians(20))
    seen = shoot(ball, extras=Extras(cameras=GivenCameras(k)))
    boxes = seen["box/bounding_box_2d_loose"]
    assert np.all(boxes[:, :2] > -8) and np.all(boxes[:, 2:] < np.array(SIZE) + 8)
    assert np.all(boxes[:, 3] - boxes[:, 1] > 0.5 * SIZE[1])
    k = np.array([[90.0, 0, -5], [0, 90, 36], [0, 0, 1]])
    with pytest.raises(InputError, match="principal point"):
        shoot(ball, extras=Extras(cameras=GivenCameras(k)))


def test_a_camera_file_says_the_same_as_the_arrays(tmp_path):
    place = look_at(np.array([0.4, 0.1, 0.3]), np.array([0, 0, 0.05]))
    cameras = [{"eye": [0.4, 0.1, 0.3], "target": [0, 0, 0.05]}, {"extrinsics": place.round(7).tolist()}]
    pinhole = {"fx": 600, "fy": 601, "cx": 320, "cy": 240}
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps({"width": 640, "height": 480, "intrinsics": pinhole, "cameras": cameras}))
    given = read_cameras(path)
    assert (given.width, given.height) == (640, 480)
    np.testing.assert_array_equal(given.intrinsics, [[600, 0, 320], [0, 601, 240], [0, 0, 1]])
    np.testing.assert_array_equal(given.extrinsics[0], place)
    np.testing.assert_allclose(given.extrinsics[1], place, atol=2e-7)
    rotation = given.extrinsics[1][:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("{", "Invalid JSON"),
        ('{"fov": 40}', "fov"),
        ('{"cameras": []}', "at least 1"),
        ('{"cameras": [{"eye": [0, 0, 1]}]}', "either extrinsics or eye and target"),
        ('{"cameras": [{"eye": [0, 0, 1], "target": [0, 0, 1]}]}', "stands on its target"),
        ('{"cameras": [{"extrinsics": [[2,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}]}', "no rigid motion"),
        ('{"cameras": [{"extrinsics": [[-1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}]}', "no rigid motion"),
        ('{"intrinsics": [[500, 2, 320], [0, 500, 240], [0, 0, 1]]}', "no skew"),
        ('{"intrinsics": {"fx": -5, "fy": 5, "cx": 1, "cy": 1}}', "intrinsics.fx: must be more than 0"),
        ('{"intrinsics": {"fx": NaN, "fy": 5, "cx": 1, "cy": 1}}', "finite"),
    ],
)
def test_a_camera_file_that_no_camera_can_be_is_refused_by_name(tmp_path, text, says):
    path = tmp_path / "cameras.json"
    path.write_text(text)
    with pytest.raises(InputError, match=r"cameras\.json.*" + says):
        read_cameras(path)


def test_the_drawn_hand_is_in_its_own_pictures_and_in_no_other(ball):
    hand = two_finger_hand()
    # Palm 0.12 m above the first ball, looking down; the second scene has no grasp.
    pose = np.array([[0.02, -0.01, 0.16, 0, 1.0, 0, 0]] * 2)
    drawn = DrawnHand(hand, np.array([5, -1], np.int32), pose, np.zeros((2, 2)))
    plain, seen = shoot(ball), shoot(ball, extras=Extras(drawn=drawn))
    for name, values in plain.items():
        np.testing.assert_array_equal(values, seen[name])
    assert seen["camera/hand_grasp"].tolist() == [5, 5, -1, -1]
    changed = (seen["image/rgb_hand"] != seen["image/rgb"]).any(axis=-1)
    assert changed[:2].mean(axis=(1, 2)).min() > 0.05
    assert not changed[2:].any()


def test_channels_are_named_in_any_order_and_move_pictures_alone() -> None:
    assert parse_channels(["occlusion", " distance"]) == ("distance", "occlusion")
    assert parse_channels(["all"]) == ("distance", "normals", "occlusion")
    assert parse_channels([""]) == ()
    with pytest.raises(InputError, match="unknown channel 'flow'"):
        parse_channels(["flow"])

    def address(stage: Stage, *channels: str) -> str:
        request = JobRequest(hand="h", object="o", scenes=1, views=1, channels=channels)
        return shard_id(stage, request=request, hand_digest="a", object_digest="b", batch=0, count=1, revision=1)

    assert address(Stage.RENDER, "occlusion", "distance") == address(Stage.RENDER, "distance", "occlusion")
    assert address(Stage.RENDER, "distance") != address(Stage.RENDER)
    assert address(Stage.SCENE, "distance") == address(Stage.SCENE)
