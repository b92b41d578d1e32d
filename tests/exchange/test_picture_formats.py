"""Pictures in the layouts of others, read back by other readers."""

import io
import json
import tarfile

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from graspd.exchange import replicator, webdataset
from graspd.service.model.errors import InputError
from graspd.service.readers import Pictures, Shards, open_shards
from graspd.service.settings import Settings
from graspd.service.store.shards import Shard
from graspd.service.store.store import open_store
from graspd.worker.rendering.annotate import box_corners
from tests.api import factories
from tests.indexes import open_services

H, W = 24, 32
K = np.array([[30.0, 0, 17], [0, 28, 11], [0, 0, 1]])
#: World to camera: somewhere above, looking at the origin.
CAMERA = np.eye(4)
CAMERA[:3, :3] = Rotation.from_euler("xyz", [2.6, 0.2, 0.4]).as_matrix()
CAMERA[:3, 3] = [0.02, -0.01, 0.6]


@pytest.fixture
def views() -> Shard:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", [0.3, -0.5, 1.0]).as_matrix()
    pose[:3, 3] = [0.05, 0.02, 0.04]
    local = box_corners(np.array([[-0.02, -0.03, -0.05], [0.04, 0.01, 0.02]]))
    world = local @ pose[:3, :3].T + pose[:3, 3]
    corners = world @ CAMERA[:3, :3].T + CAMERA[:3, 3]
    arrays = {
        "camera/intrinsics": K[None],
        "camera/extrinsics": CAMERA[None],
        "camera/scene_index": np.zeros(1, np.int32),
        "camera/eye": np.zeros(1, np.uint8),
        "camera/stereo_baseline_m": np.zeros(1),
        "image/rgb": np.zeros((1, H, W, 3), np.uint8),
        "image/depth": np.ones((1, H, W), np.float32),
        "image/segmentation": np.full((1, H, W), 2, np.uint8),
        "box/bounding_box_2d_tight": np.array([[3, 4, 20, 15]], np.float32),
        "box/bounding_box_2d_loose": np.array([[2.6, 4, 21, 15]], np.float32),
        "box/bounding_box_3d": corners[None].astype(np.float32),
        "box/occlusion_ratio": np.array([0.25], np.float32),
    }
    return Shard("views", {"object": "mug"}, arrays)


def test_3d_box_of_replicators_layout_has_the_corners_of_ours(views: Shard, tmp_path) -> None:
    replicator.write(views, tmp_path)
    (row,) = np.load(tmp_path / "bounding_box_3d_0000.npy")
    local = box_corners(np.array([[row[f"{axis}_{end}"] for axis in "xyz"] for end in ("min", "max")], float))
    world = np.concatenate([local, np.ones((8, 1))], axis=1) @ row["transform"].astype(float)  # row vectors
    corners = world[:, :3] @ CAMERA[:3, :3].T + CAMERA[:3, 3]
    np.testing.assert_allclose(corners, views["box/bounding_box_3d"][0], atol=1e-6)  # float32 of the file


def test_usds_matrices_put_a_point_on_the_same_pixel(views: Shard, tmp_path) -> None:
    replicator.write(views, tmp_path)
    said = json.loads((tmp_path / "camera_params_0000.json").read_text())
    view, projection = (np.reshape(said[f"camera{name}"], (4, 4)) for name in ("ViewTransform", "Projection"))
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (20, 3))
    clip = np.concatenate([points, np.ones((20, 1))], axis=1) @ view @ projection  # row vectors, as USD has them
    ndc = clip[:, :2] / clip[:, 3:]
    pixels = np.stack([(ndc[:, 0] + 1) / 2 * W, (1 - ndc[:, 1]) / 2 * H], axis=1)
    in_camera = (points @ CAMERA[:3, :3].T + CAMERA[:3, 3]) @ K.T
    np.testing.assert_allclose(pixels, in_camera[:, :2] / in_camera[:, 2:], atol=1e-9)


def test_2d_boxes_are_whole_pixels_of_what_is_in_view(views: Shard, tmp_path) -> None:
    replicator.write(views, tmp_path)
    (row,) = np.load(tmp_path / "bounding_box_2d_tight_0000.npy")
    assert [int(row[name]) for name in ("x_min", "y_min", "x_max", "y_max")] == [3, 4, 20, 15]
    assert float(row["occlusionRatio"]) == 0.25
    labels = json.loads((tmp_path / "bounding_box_2d_tight_labels_0000.json").read_text())
    assert labels == {"0": {"class": "mug"}}
    views.arrays["box/bounding_box_2d_tight"] = np.full((1, 4), np.nan, np.float32)
    replicator.write(views, tmp_path / "unseen")
    assert len(np.load(tmp_path / "unseen" / "bounding_box_2d_tight_0000.npy")) == 0


def test_every_picture_is_one_sample_with_its_grasps(tmp_path) -> None:
    services = open_services(Settings(data_dir=tmp_path), open_store("memory://"))
    factories.add_builtins(services)
    record = factories.add_job(services, scenes=2, views=2, width=W, height=H)
    factories.finish_all(services, record)
    shards = open_shards(services.store, job=record.id, cache=tmp_path / "cache")
    services.close()
    written = webdataset.write(shards, tmp_path / "tars", pictures_a_file=3)
    members: list[str] = []
    for path in written:
        with tarfile.open(path) as tar:
            members += tar.getnames()
    kinds = ("rgb.png", "depth.exr", "segmentation.png", "json")
    assert sorted(members) == sorted(f"{number:08}.{kind}" for number in range(4) for kind in kinds)
    assert len(written) == 2 and len(Pictures(shards)) == 4
    (path,) = webdataset.write(shards, tmp_path / "one")
    expected = Pictures(shards)[1]
    with tarfile.open(path) as tar:
        record = json.loads(tar.extractfile("00000001.json").read())  # type: ignore[union-attr]
        image = Image.open(io.BytesIO(tar.extractfile("00000001.rgb.png").read()))  # type: ignore[union-attr]
        np.testing.assert_array_equal(np.array(image), expected["image/rgb"])
    np.testing.assert_allclose(record["grasps"]["hand_pose"], expected["grasp/hand_pose"])
    assert record["grasp_frame"] == "camera"
    with pytest.raises(InputError, match="no picture"):
        webdataset.write(Shards(shards.of_kind("base")), tmp_path / "none")
