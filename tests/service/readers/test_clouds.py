"""Clouds of closed-form pictures: points, normals, frames, labels, graspness; noise and holes of depth cameras."""

import re
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graspd.service.model import transforms
from graspd.service.model.errors import InputError
from graspd.service.model.pinhole import pixel_rays
from graspd.service.readers import Pictures, open_shards
from graspd.service.readers.clouds import graspness
from graspd.service.readers.depth_noise import NOISES, DepthNoise, parse_depth_noise, shadow_mask
from graspd.service.store.shards import read_shard
from tests.conftest import REPOSITORY
from tests.service.readers import box_scenes
from tests.service.readers.box_scenes import EYES, POSES, SCENE_OF_GRASP, SIZE, VALID

#: Pictures keep depth in float32: half a unit in the last place of half a metre is 3e-8, of a point 6e-8 [m].
DEPTH_M = 1e-7
VIEWS = len(EYES)


@pytest.fixture(scope="module")
def pictures(box: Path) -> Pictures:
    return Pictures(open_shards(box))


def on_box(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance from the box's surface [m] and the face's normal, of points in the object's frame."""
    over = np.abs(points) - SIZE / 2
    face = over.argmax(axis=1)
    inward = np.take_along_axis(over, face[:, None], 1)[:, 0]
    outward = np.linalg.norm(np.maximum(over, 0), axis=1)
    normal = np.zeros_like(points)
    normal[np.arange(len(points)), face] = np.sign(points[np.arange(len(points)), face])
    return np.where(inward > 0, outward, -inward), normal


def test_points_of_the_object_lie_on_it(pictures: Pictures) -> None:
    for sample in pictures.clouds(500, frame="object"):
        assert sample["cloud/points"].shape == sample["cloud/normals"].shape == (500, 3)
        distance, normal = on_box(sample["cloud/points"].astype(float))
        assert distance.max() < 4 * DEPTH_M
        # Where a face is one or two pixels wide, its neighbour's bends as little: a twentieth of these pictures.
        agree = np.einsum("pc,pc->p", normal, sample["cloud/normals"]) > 1 - 1e-4  # float32 over steps of 4 mm
        assert agree.mean() > 0.9
        assert sample["cloud/object"].all()


def test_frames_are_those_of_the_cameras_and_of_the_object(pictures: Pictures) -> None:
    frames = ("camera", "table", "object")
    per_frame = {frame: pictures.clouds(64, frame=frame, seed=3, scene=True) for frame in frames}
    for index in (0, VIEWS):
        camera, table, own = (per_frame[frame][index] for frame in frames)
        e = camera["camera/extrinsics"]
        expected = table["cloud/points"] @ e[:3, :3].T + e[:3, 3]
        np.testing.assert_allclose(camera["cloud/points"], expected, atol=4 * DEPTH_M)
        rest = transforms.pose_to_matrix(POSES[camera["scene"]])
        np.testing.assert_allclose(own["cloud/points"] @ rest[:3, :3].T + rest[:3, 3], table["cloud/points"], atol=4e-7)
        np.testing.assert_allclose(camera["cloud/normals"], table["cloud/normals"] @ e[:3, :3].T, atol=1e-6)
        np.testing.assert_allclose(transforms.pose_to_matrix(camera["object/pose"]), e @ rest, atol=1e-12)
        np.testing.assert_allclose(table["object/pose"], POSES[camera["scene"]], atol=1e-12)
        assert table["table/plane"].tolist() == [0, 0, 1, 0] and table["table/height"] == 0
        for cloud in (camera, own):  # the points of the table lie on its plane, in every frame
            plane, on_table = cloud["table/plane"], cloud["cloud/object"] == 0
            assert 0 < on_table.mean() < 1
            np.testing.assert_allclose(cloud["cloud/points"][on_table] @ plane[:3], plane[3], atol=1e-6)
        # Rows and columns are those of the pixels.
        image = camera["cloud/points"] @ camera["camera/intrinsics"].T
        pixel = camera["cloud/pixel"][:, [2, 1]] + 0.5
        np.testing.assert_allclose(image[:, :2] / image[:, 2:], pixel, atol=1e-4)  # float32 of 96 px


def test_views_fused_agree_and_show_more_than_each(pictures: Pictures) -> None:
    clouds = pictures.clouds(4000, fuse=True, frame="object")
    assert len(clouds) == len(POSES)
    for scene, sample in enumerate(clouds):
        assert sample["scene"] == scene and sample["camera/extrinsics"].shape == (VIEWS, 4, 4)
        assert set(np.unique(sample["cloud/pixel"][:, 0])) == set(range(VIEWS))
        distance, normal = on_box(sample["cloud/points"].astype(float))
        assert distance.max() < 4 * DEPTH_M
        single = pictures.clouds(4000, frame="object")[scene * VIEWS]
        faces = [len(np.unique(np.round(n), axis=0)) for n in (normal, on_box(single["cloud/points"].astype(float))[1])]
        assert faces[0] > faces[1]


def test_labels_stand_in_each_frame_and_are_the_valid_grasps(pictures: Pictures, box: Path) -> None:
    base = read_shard(box / "base.h5")
    clouds = pictures.clouds(8, postures=("pregrasp", "grasp", "squeeze"))
    for index in (1, VIEWS + 2):
        sample = clouds[index]
        in_scene = transforms.pose_to_matrix(POSES[sample["scene"]])
        rows = np.flatnonzero((sample["scene"] == SCENE_OF_GRASP) & (VALID == 1))
        np.testing.assert_array_equal(sample["grasp/base_row"], rows)
        for posture in ("pregrasp", "grasp", "squeeze"):
            own = np.asarray(base[f"{posture}/hand_pose"], float)[rows]
            in_table = in_scene @ transforms.pose_to_matrix(own)
            np.testing.assert_array_equal(sample[f"{posture}/hand_pose_object"], own)
            for frame, expected in (("_table", in_table), ("_camera", sample["camera/extrinsics"] @ in_table)):
                found = transforms.pose_to_matrix(sample[f"{posture}/hand_pose{frame}"])
                np.testing.assert_allclose(found, expected, atol=1e-12)
            np.testing.assert_array_equal(sample[f"{posture}/hand_pose"], sample[f"{posture}/hand_pose_camera"])
            joints = np.asarray(base[f"{posture}/joint_positions"])[rows]
            np.testing.assert_array_equal(sample[f"{posture}/joint_positions"], joints)


def test_the_same_seed_gives_the_same_clouds(pictures: Pictures) -> None:
    def points(epoch: int, **options: Any) -> np.ndarray:
        clouds = pictures.clouds(256, noise="stereo", **options)
        clouds.epoch = epoch
        return np.asarray(clouds[2]["cloud/points"])

    np.testing.assert_array_equal(points(0), points(0))
    assert (points(0) != points(1)).any() and (points(0) != points(0, seed=1)).any()


@pytest.mark.parametrize("noise", ["stereo", "structured_light", "tof"])
def test_noisy_points_stay_within_the_cameras_noise_of_the_box(pictures: Pictures, noise: str) -> None:
    clean, noisy = pictures.clouds(600, frame="object"), pictures.clouds(600, frame="object", noise=noise)
    for index in (0, 4):
        sample = noisy[index]
        assert 0.5 * clean[index]["cloud/seen"] < sample["cloud/seen"] < clean[index]["cloud/seen"] + 1
        distance, normal = on_box(sample["cloud/points"].astype(float))
        # At 0.4 m: 0.6 mm (stereo), 1.2 mm, 0.5 mm along the axis; those on edges bleed and fly.
        assert 1e-5 < np.median(distance) < 1.2e-3
        cosine = np.einsum("pc,pc->p", normal, sample["cloud/normals"])
        assert np.median(cosine) > 0.95
        eye = transforms.apply(transforms.invert(POSES[sample["scene"]]), np.array(EYES[index % VIEWS]))
        assert (np.einsum("pc,pc->p", sample["cloud/normals"], eye - sample["cloud/points"]) > 0).all()


def test_a_voxel_holds_one_point(pictures: Pictures) -> None:
    edge = 0.011  # no face lies on the border between cubes, where float32 would put points on either side
    sample = pictures.clouds(3000, fuse=True, voxel_m=edge)[0]
    own = np.unique(sample["cloud/points"], axis=0)
    every = np.unique(pictures.clouds(3000, fuse=True)[0]["cloud/points"], axis=0)
    assert len(own) == sample["cloud/seen"] < len(every)
    assert len(np.unique(np.floor(own.astype(float) / edge), axis=0)) == len(own)


def test_where_nothing_is_seen_the_cloud_is_zero_and_says_so(pictures: Pictures) -> None:
    noise = DepthNoise(400.0, dropout=1.0)
    sample = pictures.clouds(16, noise=noise, hand_surface=lambda *_: np.zeros((3, 1, 3)))[0]
    assert sample["cloud/seen"] == 0
    assert not sample["cloud/points"].any() and not sample["cloud/graspness"].any()


def test_graspness_is_the_share_of_grasps_that_touch_the_point() -> None:
    points = np.array([[0, 0, 0], [0.01, 0, 0], [0.5, 0, 0]])
    hands = np.array([[[0, 0, 0.004], [0.011, 0, 0]], [[0.009, 0, 0], [0.2, 0, 0]], [[0, 0.0051, 0], [1, 1, 1]]])
    assert graspness(points, hands, touch_m=0.005).tolist() == pytest.approx([1 / 3, 2 / 3, 0])
    assert graspness(points, hands[:0]).tolist() == [0, 0, 0]
    assert graspness(points[:0], hands).shape == (0,)


def test_graspness_of_a_cloud_is_that_of_its_true_points(pictures: Pictures) -> None:
    """Hands that are the +x half of the box, grown by 4 mm, touch that half and nothing else."""
    grid = np.stack(np.meshgrid(*[np.linspace(-s / 2, s / 2, 15) for s in SIZE]), -1).reshape(-1, 3)
    half = grid[grid[:, 0] > 0]

    def surface(_: Any, rows: np.ndarray) -> np.ndarray:
        return np.stack([np.resize(half if row % 2 else grid, grid.shape) for row in rows])

    sample = pictures.clouds(500, noise="tof", frame="object", hand_surface=surface)[0]
    odd = (sample["grasp/base_row"] % 2).mean()
    assert 0 < odd < 1 and len(pictures.clouds(500, frame="object")) == 6
    values = sample["cloud/graspness"]
    assert set(np.round(np.unique(values), 6)) == {np.float32(round(1 - odd, 6)), np.float32(1)}
    far = np.abs(sample["cloud/points"]).max(axis=1) < 0.06  # not those that fly
    right, left = sample["cloud/points"][:, 0] > 0.01, sample["cloud/points"][:, 0] < -0.01
    assert (values[right & far] == 1).mean() > 0.95
    assert (values[left & far] < 1).mean() > 0.95


@pytest.mark.parametrize(
    ("option", "value"),
    [
        *[("noise", "lidar"), ("frame", "moon"), ("postures", ["rest"]), ("points", 0), ("voxel_m", -1.0)],
        *[("seed", -1), ("frame", "camera")],
    ],
)
def test_what_no_cloud_can_be_is_refused(pictures: Pictures, option: str, value: Any) -> None:
    with pytest.raises(InputError):
        pictures.clouds(**{"fuse": value == "camera", option: value})


def test_the_page_runs_as_it_is_printed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "demo-out").mkdir()
    box_scenes.write(tmp_path / "demo-out" / "shards")
    monkeypatch.chdir(tmp_path)
    page = (REPOSITORY / "docs" / "how-to" / "clouds.md").read_text()
    said: dict[str, Any] = {}
    for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        if "torch" not in block or find_spec("torch") is not None:
            exec(block, said)
    sample = said["sample"]
    assert sample["cloud/points"].shape == (1024, 3) and sample["cloud/seen"] > 100
    listed = re.findall(r"^\| (`[^|]*`) \| ", page, re.MULTILINE)
    keys = {name for cell in listed for name in re.findall(r"`([\w/]+)`", cell) if "/" in name or name == "base_id"}
    sample = said["views"].clouds(8, hand_surface=lambda _, rows: np.zeros((len(rows), 1, 3)))[0]
    assert keys <= set(sample), "the table names what is not there"
    of_clouds = {name for name in sample if name.startswith(("cloud/", "camera/", "table/", "object/"))}
    assert of_clouds <= keys, "the table leaves something out"


WIDTH, HEIGHT = 320, 240
K = np.array([[330.0, 0, 160], [0, 330.0, 120], [0, 0, 1]])


def plane(distance: float, tilt_deg: float = 0.0) -> np.ndarray:
    """Depth of a plane through (0, 0, distance), turned about the camera's y axis."""
    tilt = np.radians(tilt_deg)
    normal = np.array([np.sin(tilt), 0, -np.cos(tilt)])
    return np.asarray(-distance * np.cos(tilt) / (pixel_rays(K, WIDTH, HEIGHT) @ normal))


def still(noise: DepthNoise) -> DepthNoise:
    return replace(noise, lateral_px=0.0, lateral_angle_px=0.0, mixed=False)


@pytest.mark.parametrize("name", list(NOISES))
@pytest.mark.parametrize("distance", [0.4, 0.8])
def test_the_depth_of_a_wall_scatters_as_the_model_says(name: str, distance: float) -> None:
    noise = still(NOISES[name])
    seen = noise.apply(plane(distance), K, np.random.default_rng(1))
    found = seen[np.isfinite(seen)]
    # Rays within 30 degrees of the axis: Nguyen's term of the angle adds less than a hundredth there.
    expected = float(noise.sigma(np.array(distance), np.array(np.radians(10))))
    # 60,000 samples leave 0.3 % of chance; steps as wide as the noise are not quite an even spread: 5 %.
    assert found.std() == pytest.approx(expected, rel=0.05)
    assert found.mean() == pytest.approx(distance, abs=0.15 * expected)


def test_stereo_and_structured_light_have_the_published_noise() -> None:
    noise, angle = NOISES["stereo"], np.zeros(3)
    found = noise.sigma(np.array([0.5, 1.0, 2.0]), angle)
    np.testing.assert_allclose(found / found[0], [1, 4, 16], rtol=1e-12)
    # z^2 p / (f B), with p the root of 0.08^2 and of steps of 1/32 px.
    assert found[1] == pytest.approx(np.hypot(0.08, 1 / 32 / np.sqrt(12)) / (424 * 0.05), rel=1e-12)
    noise = NOISES["structured_light"]
    for z, angle in ((0.4, 0.0), (1.0, 0.3), (1.5, 1.2)):
        published = 0.0012 + 0.0019 * (z - 0.4) ** 2 + 0.0001 / np.sqrt(z) * angle**2 / (np.pi / 2 - angle) ** 2
        assert float(noise.axial_sigma(np.array(z), np.array(angle))) == pytest.approx(published, rel=1e-12)


def test_depths_are_steps_of_disparity_and_the_same_for_the_same_seed() -> None:
    first, again, other = (NOISES["stereo"].apply(plane(0.6), K, np.random.default_rng(seed)) for seed in (2, 2, 4))
    steps = 424 * 0.05 / first[np.isfinite(first)] * 32
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)
    np.testing.assert_array_equal(first, again)
    assert (first != other).mean() > 0.5


def test_what_the_second_eye_does_not_see_is_a_hole() -> None:
    """A board at 0.4 m before a wall at 0.8 m hides a band as wide as its disparity exceeds the wall's, on its left."""
    depth = plane(0.8)
    depth[60:180, 140:200] = 0.4
    product = 330 * 0.048  # disparities of 19.8 and 39.6 px
    hidden = shadow_mask(depth, product)
    wall, board = product / 0.8, product / 0.4
    rows = hidden[60:180]
    assert rows[:, 140:200].sum() == 0
    assert rows[:, 200:].sum() == 0
    # The wall's pixels from here to the board are carried to where the board stands: to the pixel that is rounded.
    assert rows[:, int(wall) + 1 : 140].sum(axis=1) == pytest.approx(board - wall, abs=1)
    # Where there is no board, what falls off the other picture's side: as wide as the wall's disparity.
    assert hidden[:60].sum(axis=1) == pytest.approx(wall, abs=1)
    assert not hidden[:60, int(wall) + 1 :].any()


def test_holes_are_a_share_at_random_and_where_nothing_can_be_measured() -> None:
    noise, draw = still(NOISES["stereo"]), np.random.default_rng(6)
    seen = noise.apply(plane(0.5), K, np.random.default_rng(5))
    disparity = 330 * 0.05 / 0.5
    inside = seen[:, int(disparity) + 1 :]
    chance = 4 * np.sqrt(0.01 * 0.99 / inside.size)  # four deviations of a binomial
    assert np.isnan(inside).mean() == pytest.approx(0.01, abs=chance)
    assert np.isnan(seen[:, : int(disparity) - 1]).all()
    middle = (slice(100, 140), slice(150, 170))
    assert np.isnan(noise.apply(plane(0.5, 84), K, draw)[middle]).all()
    assert np.isnan(noise.apply(plane(0.5, 70), K, draw)[middle]).mean() < 0.1
    assert np.isnan(noise.apply(plane(0.16), K, draw)).all()  # 424 px x 50 mm / 126 px = 168 mm


def test_edges_bleed_and_pixels_on_them_fly_a_little() -> None:
    depth = plane(0.8)
    depth[:, :160] = 0.4  # its shadow falls off the other side
    draw = np.random.default_rng(7)
    far = NOISES["stereo"].apply(depth, K, draw)[:, 155:165]
    bled = (np.abs(far - depth[:, 155:165]) > 0.2).mean(axis=0)
    assert bled[4:6].min() > 0.02  # beside the edge: half a pixel of 424 is 0.39 of 330
    assert bled[[0, 9]].max() == 0.0  # five pixels off
    flying = NOISES["tof"].apply(depth, K, draw)
    between = (flying > 0.45) & (flying < 0.75)
    assert between[:, 159].mean() > 0.5
    assert between.sum() == between[:, 159].sum()


def test_an_unknown_camera_is_told_the_ones_there_are() -> None:
    with pytest.raises(InputError, match="stereo, structured_light, tof"):
        parse_depth_noise("kinect")
    assert parse_depth_noise(None) is None
