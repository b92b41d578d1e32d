"""Image files of views, read back by other readers, and clouds of them against the mesh."""

import json
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import trimesh
from PIL import Image

from graspd.readers import hand_surface
from graspd.service.model.errors import InputError
from graspd.service.model.transforms import apply
from graspd.service.readers import Pictures, open_shards
from graspd.service.store.shards import Shard, write_shard
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.surface import sample_surface
from graspd.worker.rendering import render
from graspd.worker.rendering.export import PNG_STEP_M, export_images
from tests.service.readers import box_scenes
from tests.worker.models import object_from_mesh

H, W = 6, 8
DEPTH_M = 1e-4  # what a view promises of its depth [m]: tests/worker/rendering/test_views.py


@pytest.fixture
def views() -> Shard:
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.2, 0.9, (2, H, W)).astype(np.float32)
    depth[0, 0, 0], depth[1, 0, 0] = np.inf, 9.0
    eye = np.eye(4)
    eye[:3, 3] = [0, 0, 0.5]
    arrays = {
        "camera/intrinsics": np.tile(np.array([[9.0, 0, 4], [0, 9, 3], [0, 0, 1]]), (2, 1, 1)),
        "camera/extrinsics": np.tile(eye, (2, 1, 1)),
        "camera/scene_index": np.array([0, 1], np.int32),
        "camera/eye": np.array([1, 2], np.uint8),
        "camera/stereo_baseline_m": np.full(2, 0.06),
        "image/rgb": rng.integers(0, 256, (2, H, W, 3), np.uint8),
        "image/depth": depth,
        "image/segmentation": rng.integers(0, 4, (2, H, W), np.uint8),
        "image/distance": (depth * np.float32(1.1)),
        "image/normals": rng.normal(size=(2, H, W, 3)).astype(np.float16),
        "box/bounding_box_2d_tight": np.array([[1, 2, 3, 4], [np.nan] * 4], np.float32),
        "box/bounding_box_2d_loose": np.ones((2, 4), np.float32),
        "box/bounding_box_3d": np.ones((2, 8, 3), np.float32),
        "box/occlusion_ratio": np.array([0.25, np.nan], np.float32),
    }
    return Shard("views", {"object": "mug", "neighbours": ["block"]}, arrays)


def pixels(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.array(image)


def plane(path: Path, channel: str) -> np.ndarray:
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return np.array(file.channels()[channel].pixels)


def test_an_export_comes_back_exactly_with_its_cameras_and_is_not_repeated(views, tmp_path) -> None:
    export_images(views, tmp_path)
    for view in range(2):
        for file, column in (("rgb", "rgb"), ("semantic_segmentation", "segmentation")):
            np.testing.assert_array_equal(pixels(tmp_path / f"{file}_{view:04}.png"), views[f"image/{column}"][view])
        for file, column in (("distance_to_image_plane", "depth"), ("distance_to_camera", "distance")):
            found = plane(tmp_path / f"{file}_{view:04}.exr", "Z")
            np.testing.assert_array_equal(found, views[f"image/{column}"][view])
        normals = np.stack([plane(tmp_path / f"normals_{view:04}.exr", axis) for axis in "XYZ"], axis=-1)
        assert normals.dtype == np.float16
        np.testing.assert_array_equal(normals, views["image/normals"][view])
    left, right = (json.loads((tmp_path / f"view_{view:04}.json").read_text()) for view in range(2))
    assert (left["eye"], right["eye"], right["scene"], left["width"], left["height"]) == ("left", "right", 1, W, H)
    assert left["position"] == [0, 0, -0.5] and left["intrinsics"] == [[9, 0, 4], [0, 9, 3], [0, 0, 1]]
    assert left["bounding_box_2d_tight"] == [1, 2, 3, 4] and left["occlusion_ratio"] == 0.25
    assert right["bounding_box_2d_tight"] is None and right["occlusion_ratio"] is None
    labels = json.loads((tmp_path / "labels.json").read_text())
    assert [labels[k]["class"] for k in "0123"] == ["background", "table", "mug", "block"]
    with pytest.raises(InputError, match="exported views already"):
        export_images(views, tmp_path)


def test_png_depth_is_right_to_half_a_step(views, tmp_path) -> None:
    export_images(views, tmp_path, depth="png")
    steps = pixels(tmp_path / "distance_to_image_plane_0000.png")
    assert steps.dtype in (np.uint16, np.int32)
    finite = np.isfinite(views["image/depth"][0])
    error = steps * PNG_STEP_M - np.where(finite, views["image/depth"][0], 0.0)
    # Half a step, and the rounding of float32.
    assert np.abs(error).max() <= 0.5 * PNG_STEP_M + 1e-7
    assert steps[0, 0] == 0
    assert pixels(tmp_path / "distance_to_image_plane_0001.png")[0, 0] == 65535
    assert not list(tmp_path.glob("distance*.exr"))


def test_points_of_a_rendered_object_lie_on_its_mesh(tmp_path: Path) -> None:
    mesh = trimesh.creation.capsule(height=0.05, radius=0.03, count=[24, 24])
    options = {"views": 2, "stereo": False, "width": 96, "height": 72, "seed": 1, "samples": 2}
    views = render(object_from_mesh(mesh, "box"), box_scenes.POSES, **options)
    folder = box_scenes.write(tmp_path / "set")
    said = {"hand": "claw", "object": "box", "batch": 0, "shard_id": "c" * 32, "base_shard": "b" * 32}
    (folder / "views.h5").write_bytes(write_shard("views", views, said))
    pictures = Pictures(open_shards(folder))
    for sample in (*pictures.clouds(300, frame="object"), *pictures.clouds(300, fuse=True, frame="object")):
        _, distance, face = trimesh.proximity.closest_point(mesh, sample["cloud/points"].astype(float))
        assert distance.max() < DEPTH_M
        cosine = np.einsum("pc,pc->p", mesh.face_normals[face], sample["cloud/normals"])
        # Faces turn by 7.5 degrees each, and a pixel's neighbours may lie on the next one.
        assert np.quantile(cosine, 0.1) > np.cos(np.radians(12)) and np.median(cosine) > np.cos(np.radians(4))


def test_surface_of_the_hand_of_a_shard_follows_its_kinematics() -> None:
    """All of a hand moves with its root; the points of a body that no joint carries move with nothing else."""
    hand = hand_from_path("barrett")
    joints = np.zeros((2, len(hand.joint_names)))
    joints[1] = 0.3
    pose = np.array([[0.1, 0.2, 0.3, 1, 0, 0, 0], [0, 0, 0, np.sqrt(0.5), 0, 0, np.sqrt(0.5)]])
    said = {"hand": "barrett", "hand_digest": hand.digest}
    shard = Shard("base", said, {"grasp/hand_pose": pose, "grasp/joint_positions": joints})
    found = hand_surface(shard, np.array([0, 1]))
    points = sample_surface(hand, found.shape[1])
    palm = points.body == 0
    for row in range(2):
        np.testing.assert_allclose(found[row, palm], apply(pose[row], points.position[palm]), atol=1e-12)
    still = Shard("base", said, {**shard.arrays, "grasp/joint_positions": joints[[0, 0]]})
    assert np.abs(hand_surface(still, np.array([1]))[0, ~palm] - found[1, ~palm]).max() > 0.01
