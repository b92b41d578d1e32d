"""Pictures of scenes and their further channels against closed forms, projective geometry and a ray caster."""

import json
import resource

import numpy as np
import pytest
import trimesh

from graspd.service.model.digests import shard_id
from graspd.service.model.domain import JobRequest
from graspd.service.model.errors import InputError, TaskCancelled
from graspd.service.model.pinhole import pixel_rays
from graspd.service.model.states import Stage
from graspd.service.model.transforms import apply, quat_from_axis_angle
from graspd.service.store.shards import check_columns
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.objects.model import ObjectModel
from graspd.worker.rendering import Extras, cameras, render
from graspd.worker.rendering.annotate import parse_channels
from graspd.worker.rendering.cameras import Cameras, GivenCameras, intrinsics, look_at, read_cameras, sample_hemisphere
from graspd.worker.rendering.hands import DrawnHand
from graspd.worker.rendering.scenery import TABLE_SIZE
from graspd.worker.scenes import Neighbours
from tests.worker.models import object_from_mesh, two_finger_hand, unit_vectors

DEPTH_M = 1e-4  # what a view promises of its depth [m]; float32 rays over half a metre err by less than a tenth of it
SIZE = (96, 72)
RADIUS = 0.05
REST = np.array([[0.02, -0.01, RADIUS, 1.0, 0, 0, 0], [0.0, 0.03, RADIUS, 0, 1.0, 0, 0]])
#: Normals are stored with 11 bits.
HALF_PRECISION = 5e-4
#: Interpolated normals of the ball's 20 480 facets; float32 rays.
FACET_NORMAL = 2e-3
CENTRE, OBJECT_RADIUS = np.array([0.05, -0.02, 0.04]), 0.07


def shoot(obj: ObjectModel, poses: np.ndarray, **options) -> dict[str, np.ndarray]:
    options = {"views": 2, "stereo": True, "seed": 1, "samples": 2} | options
    return render(obj, poses, width=SIZE[0], height=SIZE[1], **options)


def cameras_of(views: dict[str, np.ndarray]) -> Cameras:
    height, width = views["image/depth"].shape[1:]
    return Cameras(width, height, views["camera/intrinsics"][0], views["camera/extrinsics"])


def world_rays(views: dict[str, np.ndarray], view: int) -> tuple[np.ndarray, np.ndarray]:
    """Optical centre (3,) and directions (H, W, 3) of unit depth, from the shard's K and E alone."""
    k, e = views["camera/intrinsics"][view], views["camera/extrinsics"][view]
    height, width = views["image/depth"].shape[1:]
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    local = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(k).T
    return -e[:3, :3].T @ e[:3, 3], local @ e[:3, :3]


@pytest.fixture(scope="module")
def ball() -> ObjectModel:
    # 20 480 faces: the facets lie at most 8 um inside the sphere.
    return object_from_mesh(trimesh.creation.icosphere(subdivisions=5, radius=RADIUS), "ball")


@pytest.fixture(scope="module")
def mug(shared_data) -> ObjectModel:
    return object_from_mesh(trimesh.load_mesh(shared_data / "objects" / "025_mug" / "clean.stl"), "mug")


@pytest.fixture(scope="module")
def mug_poses(mug) -> np.ndarray:
    turned = quat_from_axis_angle(np.array([1.0, 0, 0]), np.asarray(0.4))
    height = -apply(np.concatenate([np.zeros(3), turned]), mug.vertices)[:, 2].min()
    return np.array([[0, 0, -mug.vertices[:, 2].min(), 1, 0, 0, 0], [0.03, 0.02, height, *turned]])


@pytest.fixture(scope="module")
def mug_views(mug, mug_poses) -> dict[str, np.ndarray]:
    return shoot(mug, mug_poses)


@pytest.fixture(scope="module")
def channels(ball) -> dict[str, np.ndarray]:
    return shoot(ball, REST, stereo=False, extras=Extras(channels=("distance", "normals", "occlusion")))


def points(views: dict[str, np.ndarray], view: int) -> np.ndarray:
    """(H, W, 3) seen points in the table frame, from depth, K and E alone; nan where nothing is."""
    origin, rays = world_rays(views, view)
    depth = views["image/depth"][view]
    return origin + np.where(np.isfinite(depth), depth, np.nan)[..., None] * rays


def test_depths_are_of_sphere_and_plane_and_infinite_elsewhere(ball) -> None:
    ball_views = shoot(ball, REST[:1])
    for view in range(4):
        origin, rays = world_rays(ball_views, view)
        to_centre = REST[0, :3] - origin
        square = (rays**2).sum(-1)
        along = rays @ to_centre
        discriminant = along**2 - square * (to_centre @ to_centre - RADIUS**2)
        depth = (along - np.sqrt(np.maximum(discriminant, 0))) / square
        # Where the ray grazes, the facets' 8 um inside the sphere grow without bound along the ray.
        square_on = discriminant > 0.06 * square * RADIUS**2
        seen = square_on & (ball_views["image/segmentation"][view] == 2)
        assert seen.sum() > 500 and np.array_equal(seen, square_on)
        assert np.abs(ball_views["image/depth"][view] - depth)[seen].max() < DEPTH_M
        table = ball_views["image/segmentation"][view] == 1
        depth = -origin[2] / rays[..., 2]
        on_top = np.abs((origin + depth[..., None] * rays)[..., :2]).max(axis=-1) < 0.4 * min(TABLE_SIZE[:2])
        assert (table & on_top).sum() > 500
        assert np.abs(ball_views["image/depth"][view] - depth)[table & on_top].max() < DEPTH_M
    low = shoot(ball, REST[:1], views=8, stereo=False, seed=4)
    nothing = low["image/segmentation"] == 0
    assert nothing.any()
    assert np.array_equal(np.isinf(low["image/depth"]), nothing)


def test_pixels_of_known_depth_lie_on_rays_of_cameras_matrices(mug_views):
    depth = np.where(np.isfinite(mug_views["image/depth"]), mug_views["image/depth"], 1)
    for view, points in enumerate(cameras_of(mug_views).unproject(depth)):
        origin, rays = world_rays(mug_views, view)
        np.testing.assert_allclose(points, origin + depth[view, ..., None] * rays, atol=1e-9)


def test_the_right_eye_sees_every_point_shifted_by_its_disparity(mug_views):
    cams = cameras_of(mug_views)
    points = cams.unproject(np.where(np.isfinite(mug_views["image/depth"]), mug_views["image/depth"], 1))
    focal, baseline = cams.intrinsics[0, 0], mug_views["camera/stereo_baseline_m"][0]
    for left in np.flatnonzero(mug_views["camera/eye"] == 1):
        seen = mug_views["image/segmentation"][left] == 2
        rows, columns = np.nonzero(seen)
        pixels, depth = cams.project(points[left][seen])
        here, there = pixels[left], pixels[left + 1]
        np.testing.assert_allclose(here[:, 0] - there[:, 0], focal * baseline / depth[left], atol=1e-9)
        np.testing.assert_allclose(here[:, 1], there[:, 1], atol=1e-9)
        # What the right eye measures there is the same depth, unless something nearer hides the point from it.
        column = np.floor(there[:, 0]).astype(int)
        inside = (column >= 0) & (column < SIZE[0])
        other = mug_views["image/depth"][left + 1][rows[inside], column[inside]]
        mine = mug_views["image/depth"][left][rows[inside], columns[inside]]
        assert np.mean(other < mine + 0.004) > 0.9


def test_boxes_are_tight_around_mask_and_contain_what_is_visible(mug_views) -> None:
    for view, mask in enumerate(mug_views["image/segmentation"] == 2):
        cells = np.argwhere(mask)
        (top, left), (bottom, right) = cells.min(axis=0), cells.max(axis=0) + 1
        assert mug_views["box/bounding_box_2d_tight"][view].tolist() == [left, top, right, bottom]
        tight, loose = (mug_views[f"box/bounding_box_2d_{kind}"][view] for kind in ("tight", "loose"))
        # A pixel whose centre is covered reaches half a pixel past the outline.
        assert np.all(loose[:2] <= tight[:2] + 0.5) and np.all(loose[2:] >= tight[2:] - 0.5)
        corners = mug_views["box/bounding_box_3d"][view].astype(float) @ mug_views["camera/intrinsics"][view].T
        corners = corners[:, :2] / corners[:, 2:]
        assert np.all(corners.min(axis=0) <= loose[:2] + 1e-3) and np.all(corners.max(axis=0) >= loose[2:] - 1e-3)


def test_the_same_seed_gives_the_same_pixels_whatever_is_beside(mug, mug_poses, mug_views) -> None:
    again = shoot(mug, mug_poses)
    other, alone = shoot(mug, mug_poses, seed=2), shoot(mug, mug_poses[:1])
    for name, values in mug_views.items():
        np.testing.assert_array_equal(values, again[name])
    assert not np.array_equal(mug_views["camera/extrinsics"], other["camera/extrinsics"])
    for name in ("image/rgb", "image/segmentation"):
        np.testing.assert_array_equal(alone[name], mug_views[name][:4])


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("graspd.worker.rendering.tracer.PIXELS_OF_A_CORE", SIZE[0] * SIZE[1]),
        ("graspd.worker.execution_context.available_cores", lambda: 1),
        ("graspd.worker.execution_context.available_cores", lambda: 3),
    ],
    ids=["parts", "1 core", "3 cores"],
)
def test_pixels_do_not_depend_on_parts_and_cores(mug, mug_poses, mug_views, monkeypatch, name, value):
    monkeypatch.setattr(name, value)
    again = shoot(mug, mug_poses)
    np.testing.assert_array_equal(mug_views["image/rgb"], again["image/rgb"])
    np.testing.assert_array_equal(mug_views["image/depth"], again["image/depth"])


def test_columns_are_of_a_views_shard_and_mono_pictures_say_so(mug_views, ball) -> None:
    assert check_columns("views", mug_views)["V"] == 8
    assert mug_views["camera/eye"].tolist() == [1, 2] * 4
    assert mug_views["camera/scene_index"].tolist() == [0] * 4 + [1] * 4
    mono = shoot(ball, REST[:1], stereo=False)
    assert mono["camera/eye"].tolist() == [0, 0] and mono["camera/stereo_baseline_m"].tolist() == [0.0, 0.0]
    with pytest.raises(InputError, match="at least one"):
        shoot(ball, REST[:1], views=0)


def test_the_object_casts_a_shadow(ball) -> None:
    views = shoot(ball, REST[:1], views=4, stereo=False, samples=8)
    for picture, labels in zip(views["image/rgb"], views["image/segmentation"], strict=True):
        brightness = picture.astype(float).mean(axis=-1)[labels == 1]
        assert np.percentile(brightness, 2) < 0.75 * np.median(brightness)


def test_a_cancelled_render_stops_and_progress_ends_with_all(ball, monkeypatch) -> None:
    monkeypatch.setattr("graspd.worker.rendering.tracer.PIXELS_OF_A_CORE", 1)
    answers = iter([False, True])
    with pytest.raises(TaskCancelled):
        shoot(ball, REST[:1], run=ExecutionContext(cancelled=lambda: next(answers)))
    told: list[tuple[float, float, str]] = []
    shoot(ball, REST[:1], run=ExecutionContext(progress=lambda *what: told.append(what)))
    assert [done for done, _, _ in told] == sorted(done for done, _, _ in told)
    assert told[-1][:2] == (4.0, 4.0)


def test_memory_stays_flat_over_repeated_renders(ball):
    def peak() -> int:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    for seed in range(3):
        shoot(ball, REST[:1], seed=seed)
    before = peak()
    for seed in range(12):
        shoot(ball, REST[:1], seed=seed)
    # One set of image buffers is 2 MiB; twelve leaked sets or stages would be ten times the bound.
    assert peak() - before < 4096


def sampled(seed: int, views: int = 12) -> Cameras:
    rng = np.random.default_rng(seed)
    extrinsics = sample_hemisphere(CENTRE, OBJECT_RADIUS, views=views, field_of_view=cameras.FIELD_OF_VIEW, rng=rng)
    return Cameras(320, 240, intrinsics(320, 240), np.stack(extrinsics))


def test_a_camera_looks_at_its_target_upright_in_its_field() -> None:
    k = intrinsics(320, 240)
    camera = Cameras(320, 240, k, look_at(np.array([0.3, 0.2, 0.4]), CENTRE)[None])
    pixels, depth = camera.project(CENTRE + np.array([[0, 0, 0], [0, 0, 0.05]]))
    np.testing.assert_allclose(pixels[0, :, 0], [160, 160], atol=1e-9)
    assert pixels[0, 0, 1] == pytest.approx(120) and pixels[0, 1, 1] < 120
    assert depth[0, 0] == pytest.approx(np.linalg.norm(CENTRE - [0.3, 0.2, 0.4]))
    assert 2 * np.arctan(120 / k[1, 1]) == pytest.approx(cameras.FIELD_OF_VIEW)
    np.testing.assert_allclose(pixel_rays(k, 320, 240)[0, 0], [-159.5 / k[0, 0], -119.5 / k[1, 1], 1.0])


@pytest.mark.parametrize("seed", range(4))
def test_sampled_cameras_on_the_hemisphere_see_the_object(seed):
    camera = sampled(seed)
    away = camera.centre - CENTRE
    distance = np.linalg.norm(away, axis=1)
    elevation = np.arcsin(away[:, 2] / distance)
    assert np.all((elevation > cameras.ELEVATION[0] - 1e-9) & (elevation < cameras.ELEVATION[1] + 1e-9))
    assert np.all(distance >= cameras.NEAREST_M + OBJECT_RADIUS - 1e-12)
    pixels, _ = camera.project(CENTRE + OBJECT_RADIUS * 0.8 * unit_vectors(np.random.default_rng(seed), 200))
    assert np.all((pixels > 0) & (pixels < [320, 240]))


def test_sampled_azimuths_go_all_the_way_round():
    away = sampled(5).centre - CENTRE
    azimuth = np.sort(np.arctan2(away[:, 1], away[:, 0]))
    # One camera per twelfth, jittered by 0.8 of it.
    assert np.diff(np.append(azimuth, azimuth[0] + 2 * np.pi)).max() < 1.8 * 2 * np.pi / 12 + 1e-9


def test_ray_distance_is_way_from_optical_centre_to_the_point(channels):
    for view, e in enumerate(channels["camera/extrinsics"]):
        centre = -e[:3, :3].T @ e[:3, 3]
        expected = np.linalg.norm(points(channels, view) - centre, axis=-1)
        seen = np.isfinite(channels["image/depth"][view])
        assert np.array_equal(np.isinf(channels["image/distance"][view]), ~seen)
        np.testing.assert_allclose(channels["image/distance"][view][seen], expected[seen], atol=1e-6)


def test_normals_of_a_ball_point_outward_those_of_the_table_up(channels):
    for view, scene in enumerate(channels["camera/scene_index"]):
        normals = channels["image/normals"][view].astype(float)
        segmentation = channels["image/segmentation"][view]
        outward = (points(channels, view) - REST[scene, :3]) / RADIUS
        on_ball = segmentation == 2
        assert np.abs(normals - outward)[on_ball].max() < HALF_PRECISION + FACET_NORMAL + 2 * DEPTH_M / RADIUS
        on_top = (segmentation == 1) & (np.abs(points(channels, view)[..., 2]) < DEPTH_M)
        assert on_top.sum() > 500
        assert np.abs(normals[on_top] - [0, 0, 1]).max() < HALF_PRECISION
        assert not normals[segmentation == 0].any()


def test_extra_channels_change_no_other_dataset(ball, channels):
    plain = shoot(ball, REST, stereo=False)
    assert set(channels) - set(plain) == {"image/distance", "image/normals", "box/occlusion_ratio"}
    for name, values in plain.items():
        np.testing.assert_array_equal(values, channels[name])
    assert check_columns("views", channels)["V"] == 4
    assert channels["box/occlusion_ratio"].tolist() == [0.0] * 4, "alone on its table it is not occluded"


def test_a_ball_behind_another_is_hidden_as_far_as_discs_overlap(ball):
    """Two equal balls on one line of sight: the nearer covers the farther one, whose disc is smaller."""
    eye, target = np.array([0.5, 0, RADIUS]), np.array([0.0, 0, RADIUS])
    given = GivenCameras(extrinsics=np.stack([look_at(eye, target), look_at(-eye * [1, 1, -1], target)]))
    neighbour = Neighbours([ball], np.array([[[0.12, 0, RADIUS, 1.0, 0, 0, 0]]]))
    extras = Extras(channels=("occlusion",), cameras=given, neighbours=neighbour)
    seen = shoot(ball, np.array([[0, 0, RADIUS, 1.0, 0, 0, 0]]), stereo=False, extras=extras)
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
    seen = shoot(ball, np.array([[0, 0, RADIUS, 1.0, 0, 0, 0]]), stereo=False, extras=extras)
    # One column of pixels more or less of the disc's eleven across.
    assert seen["box/occlusion_ratio"][0] == pytest.approx(0.5, abs=0.06)
    given = GivenCameras(extrinsics=look_at(np.array([0.5, 0, 0.2]), np.array([1.0, 0, 0.2]))[None])
    outside = shoot(ball, REST, stereo=False, extras=Extras(channels=("occlusion",), cameras=given))
    assert np.isnan(outside["box/occlusion_ratio"]).all(), "an object out of the picture has none"


def test_given_cameras_are_those_of_every_scene(ball):
    k = np.array([[90.0, 0, 40], [0, 95.0, 30], [0, 0, 1]])
    places = np.stack([look_at(np.array(eye), np.array([0, 0, 0.03])) for eye in ([0.4, 0, 0.3], [0, 0.5, 0.2])])
    seen = shoot(ball, REST, stereo=False, views=7, extras=Extras(cameras=GivenCameras(k, places)))
    np.testing.assert_array_equal(seen["camera/extrinsics"], np.concatenate([places, places]))
    np.testing.assert_array_equal(seen["camera/intrinsics"], np.repeat(k[None], 4, axis=0))
    for view, scene in enumerate(seen["camera/scene_index"]):
        away = np.linalg.norm(points(seen, view) - REST[scene, :3], axis=-1)[seen["image/segmentation"][view] == 2]
        assert len(away) > 100
        # A ray that grazes the facets errs more along itself; they lie at most 8 um inside the ball.
        assert np.abs(away - RADIUS).max() < DEPTH_M


def test_cameras_keep_object_in_a_narrow_field_or_are_refused(ball) -> None:
    k = intrinsics(*SIZE, field_of_view=np.radians(20))
    seen = shoot(ball, REST, stereo=False, extras=Extras(cameras=GivenCameras(k)))
    boxes = seen["box/bounding_box_2d_loose"]
    assert np.all(boxes[:, :2] > -8) and np.all(boxes[:, 2:] < np.array(SIZE) + 8)
    assert np.all(boxes[:, 3] - boxes[:, 1] > 0.5 * SIZE[1])
    k = np.array([[90.0, 0, -5], [0, 90, 36], [0, 0, 1]])
    with pytest.raises(InputError, match="principal point"):
        shoot(ball, REST, stereo=False, extras=Extras(cameras=GivenCameras(k)))


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
        ('{"cameras": [{"eye": [0, 0, 1], "target": [0, 0, 1]}]}', "has its eye at its target"),
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
    plain, seen = shoot(ball, REST, stereo=False), shoot(ball, REST, stereo=False, extras=Extras(drawn=drawn))
    for name, values in plain.items():
        np.testing.assert_array_equal(values, seen[name])
    assert seen["camera/hand_grasp"].tolist() == [5, 5, -1, -1]
    changed = (seen["image/rgb_hand"] != seen["image/rgb"]).any(axis=-1)
    assert changed[:2].mean(axis=(1, 2)).min() > 0.05 and not changed[2:].any()


def test_channels_are_named_in_any_order_and_move_pictures_alone() -> None:
    assert parse_channels(["occlusion", " distance"]) == ("distance", "occlusion")
    assert parse_channels(["all"]) == ("distance", "normals", "occlusion") and parse_channels([""]) == ()
    with pytest.raises(InputError, match="unknown channel 'flow'"):
        parse_channels(["flow"])

    def address(stage: Stage, *channels: str) -> str:
        request = JobRequest(hand="h", object="o", scenes=1, views=1, channels=channels)
        return shard_id(stage, request=request, hand_digest="a", object_digest="b", batch=0, count=1, revision=1)

    assert address(Stage.RENDER, "occlusion", "distance") == address(Stage.RENDER, "distance", "occlusion")
    assert address(Stage.RENDER, "distance") != address(Stage.RENDER)
    assert address(Stage.SCENE, "distance") == address(Stage.SCENE)
