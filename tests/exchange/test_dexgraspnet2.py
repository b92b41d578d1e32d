"""A folder that DexGraspNet 2.0 trains on: each field as its loader reads it, grasps as they were. The loader is
rebuilt here from its source, without its draws of chance, its sparse tensors and torch.

yl-wang996/DexGraspNet2, src/utils/dataset.py at cc03dc65505ab47482582d4641d81b4159e8aa1d (`GraspNetDataset`), with
configs/network/train_dex_ours.yaml there. How a depth picture becomes points, and which are taken, is its
src/utils/pc.py, how graspness is made src/preprocess/dex_graspness.py, both as zcyqyq/DexTouch-sim2real has them at
7824d859a8da1d942bc38709a9d217dfb548db5d.
"""

import io
import random
import shutil
import tracemalloc
import zipfile
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.io
import trimesh
from PIL import Image

from graspd.exchange import dexgraspnet2
from graspd.exchange.dexgraspnet2 import (
    SceneGraspness,
    aim_points,
    lines_of_sight,
    load_npz,
    sum_graspness,
    surface_samples,
)
from graspd.exchange.plan import PictureReference
from graspd.service.model.errors import InputError
from graspd.service.model.transforms import IDENTITY_POSE, apply, compose, pose_from_matrix
from graspd.service.readers import Pictures, open_shards
from graspd.service.store.shards import Shard, read_shard, write_shard
from graspd.worker.grasps import GraspSet, Posture
from graspd.worker.hands.jaws import fingertip_pad
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.rendering.annotate import TABLE
from tests.worker.commands_run import graspd, refused

#: Of GraspNet: what is farther from the box around the objects is cut off [m].
OUTLIER = 0.02
TRAIN, VAL = range(90), range(90, 100)
#: Poses go through matrices in float64 and there and back between frames [m].
ROUNDING_M = 1e-9
#: Half a step of depth, 0.05 mm, along a ray that is at most 1.3 times as long [m].
POINT_M = 8e-5
DOWN = np.array([[0.0, 0, -1]])
ABOVE = np.array([[0.0, 0, 0.1]])
#: 100 px to a metre at a metre, a picture of 2 x 4.
K = np.array([[100.0, 0, 1], [0, 100, 0.5], [0, 0, 1]])


def sample(root: Path, scene: str, view: int, hand) -> SimpleNamespace:
    path = root / "data" / "scenes" / scene / "realsense"
    pictures = [(path / kind / f"{view:04}.png").read_bytes() for kind in ("depth_gt", "label_gt")]
    depth, seg = (np.array(Image.open(io.BytesIO(picture))) for picture in pictures)
    meta = scipy.io.loadmat(path / "meta" / f"{view:04}.mat")
    poses, align = np.load(path / "camera_poses.npy"), np.load(path / "cam0_wrt_table.npy")
    cloud = _points(depth, meta["intrinsic_matrix"], meta["factor_depth"])
    assert seg.any(), "a view without objects is drawn anew"
    mask = (depth > 0) & _workspace(cloud, seg, align @ poses[view])
    cloud, seg = cloud[mask], seg[mask]
    (file,) = (root / "data" / "dex_grasps_new" / scene / "barrett").iterdir()
    grasps = load_npz(file)
    turn, place = poses[view][:3, :3], poses[view][:3, 3]
    values = root / "data" / "dex_graspness_new" / scene / "realsense" / f"{view:04}.npy"
    graspness = np.zeros(len(cloud), np.float32)
    if values.exists():
        graspness = np.log(np.load(values).reshape(-1) + 1e-3)
        # It draws points by number and takes the same numbers here: another length is another cloud.
        assert len(graspness) == len(cloud)
    pose = meta["poses"][:, :, 0]
    return SimpleNamespace(
        view=view,
        file=file,
        camera=poses[view],
        on_table=align @ poses[view],
        placed=lambda points: points @ pose[:, :3].T + pose[:, 3],
        point_clouds=cloud,
        seg=seg,
        rot=np.einsum("ji,njk->nik", turn, grasps["rotation"]),
        trans=(grasps["translation"] - place) @ turn,
        qpos=np.stack([grasps[name] for name in hand.joint_names], axis=-1),
        row=grasps["row"],
        point=(grasps["point"] - place) @ turn,
        graspness=graspness,  # logarithms, of each point of the cloud
        has_graspness=values.exists(),
    )


def drawn(root: Path, split: range, hand, count: int, seed: int):
    """Samples of views that are there; a scene that is missing makes it draw again."""
    views = [(f"scene_{number:04}", view) for number in split for view in range(256)]
    there = [view for view in views if (root / "data" / "scenes" / view[0]).is_dir()]
    for scene, view in random.Random(seed).sample(there, count):
        yield sample(root, scene, view, hand)


def _points(depth: np.ndarray, intrinsics: np.ndarray, factor: np.ndarray) -> np.ndarray:
    u, v = np.meshgrid(np.arange(depth.shape[1]), np.arange(depth.shape[0]))
    z = depth / factor
    x, y = ((at - intrinsics[k, 2]) * z / intrinsics[k, k] for k, at in enumerate((u, v)))
    return np.stack([x, y, z], axis=-1)


def _workspace(cloud: np.ndarray, seg: np.ndarray, trans: np.ndarray) -> np.ndarray:
    flat = np.concatenate([cloud.reshape(-1, 3), np.ones((seg.size, 1))], axis=-1)
    there = np.einsum("ab,nb->na", trans, flat)[:, :3].reshape(cloud.shape)
    low, high = there[seg > 0].min(axis=0) - OUTLIER, there[seg > 0].max(axis=0) + OUTLIER
    return ((there > low) & (there < high)).all(axis=-1)


def pointed(palm: np.ndarray, middle: np.ndarray, surface: np.ndarray) -> int:
    """Of its script: which point (S, 3) of the object a grasp points at, from its palm and between its fingers."""
    line = (middle - palm) / np.linalg.norm(middle - palm)
    seen = {}
    for number, place in enumerate(surface):
        height = float((place - palm) @ line)
        angle = np.degrees(np.arccos(abs(height) / np.linalg.norm(place - palm)))
        if height > 0 and angle < 30:
            seen[number] = (height, angle)
    least = min(height for height, _ in seen.values())
    weight = {
        number: np.exp(-np.log(2) * (angle / 10 + (height - least) / 0.015))
        for number, (height, angle) in seen.items()
        if height - least < 0.02
    }
    return max(weight, key=lambda number: weight[number])


def graspness_at(place: np.ndarray, surface: np.ndarray, points: np.ndarray) -> float:
    """Of its script: graspness of one point of the cloud on the object, whose grasps point at `points` (K, 3)."""
    squares = ((surface - place) ** 2).sum(axis=1)
    nearest = int(squares.argmin())
    if squares[nearest] >= 0.015:
        return 0.0
    return float(sum(10 ** (-150 * np.linalg.norm(surface[nearest] - point)) for point in points))


@pytest.fixture(scope="module")
def split(root: Path) -> range:
    return TRAIN if next((root / "data" / "dex_grasps_new" / "scene_0000").rglob("*.npz")).stem == "block" else VAL


def test_every_view_that_may_be_drawn_can_be_read(root: Path, hand) -> None:
    for split in (TRAIN, VAL):
        for found in drawn(root, split, hand, 6, seed=3):
            assert set(np.unique(found.seg)) <= {0, 1} and (found.seg == 1).sum() > 20
            count = len(found.trans)
            assert found.rot.shape == (count, 3, 3) and found.qpos.shape == (count, 8) and count
            np.testing.assert_allclose(np.linalg.det(found.rot), 1, atol=1e-12)


def test_a_fingertip_stands_where_ours_does_in_the_camera(root, split, hand, stored: Shard, on_tables: Path) -> None:
    pictures = Pictures(open_shards(on_tables))
    tip = hand.fingertips[0]
    for found in drawn(root, split, hand, 6, seed=4):
        rows = found.row
        in_root = body_poses(hand, np.tile(IDENTITY_POSE, (len(rows), 1)), found.qpos)[:, tip, :3]
        there = np.einsum("nij,nj->ni", found.rot, in_root) + found.trans
        (number,) = set(stored["grasp/scene_index"][rows].tolist())
        # The picture of the same scene and view, two a scene; others are these again.
        seen = [one for one in pictures if one["object"] == "block" and one["scene"] == number][found.view % 2]
        poses = compose(seen["object/pose"], stored["grasp/hand_pose"][rows])
        ours = body_poses(hand, poses, stored["grasp/joint_positions"][rows])[:, tip, :3]
        np.testing.assert_allclose(there, ours, atol=ROUNDING_M)
        assert len(rows)


def test_the_object_of_the_cloud_is_where_grasps_mean_it(root, split, hand, block) -> None:
    mesh = trimesh.Trimesh(block.vertices, block.faces, process=False)
    for found in drawn(root, split, hand, 4, seed=5):
        there = compose(pose_from_matrix(np.linalg.inv(found.camera)), dexgraspnet2._object_pose(found.file, 0))
        points = found.point_clouds[found.seg == 1]
        local = (points - there[:3]) @ trimesh.transformations.quaternion_matrix(there[3:])[:3, :3]
        assert np.abs(trimesh.proximity.closest_point(mesh, local)[1]).max() < POINT_M
        rest = apply(pose_from_matrix(found.on_table), found.point_clouds[found.seg == 0])
        assert np.abs(rest[:, 2]).max(initial=0) < POINT_M


def test_grasps_point_and_graspness_is_as_its_script_says(root, split, hand, stored: Shard, block) -> None:
    surface = surface_samples(block)
    pads = [fingertip_pad(hand, tip).centre for tip in hand.fingertips]
    (found,) = drawn(root, split, hand, 1, seed=6)
    for number, row in enumerate(found.row):
        pose = stored["grasp/hand_pose"][row].astype(float)
        bodies = body_poses(hand, pose[None], stored["grasp/joint_positions"][row][None])[0]
        # A Barrett's thumb is its third finger.
        first, second, thumb = (apply(bodies[tip], pad) for tip, pad in zip(hand.fingertips, pads, strict=True))
        best = pointed(apply(pose, hand.palm.centre), ((first + second) / 2 + thumb) / 2, surface)
        np.testing.assert_allclose(found.point[number], found.placed(surface)[best], atol=ROUNDING_M)
    assert len(found.row)
    for other in drawn(root, split, hand, 3, seed=7):
        assert other.has_graspness
        there = other.placed(surface)
        mine = np.flatnonzero(other.seg == 1)
        for number in mine[:: max(1, len(mine) // 40)]:
            value = graspness_at(other.point_clouds[number], there, other.point)
            np.testing.assert_allclose(other.graspness[number], np.log(value + 1e-3), rtol=1e-5)
        np.testing.assert_allclose(other.graspness[other.seg != 1], np.log(1e-3), rtol=1e-6)
        assert other.graspness.max() > np.log(0.5)


def test_graspness_belongs_to_cloud_that_a_depth_camera_tells(on_tables: Path, hand, tmp_path: Path) -> None:
    graspd("export --format dexgraspnet2 --noise stereo -o", tmp_path, on_tables)
    for found in drawn(tmp_path, TRAIN, hand, 4, seed=8):
        assert found.has_graspness and (found.graspness[found.seg == 1] > np.log(1e-3)).any()


def test_a_view_of_nothing_has_no_cloud_and_no_graspness(on_tables: Path, hand, tmp_path: Path) -> None:
    views = read_shard(on_tables / "block-views.h5", kind="views")
    labels = np.array(views["image/segmentation"])
    labels[::2] = np.minimum(labels[::2], TABLE)
    shards = tmp_path / "shards"
    shards.mkdir()
    (shards / "block.h5").write_bytes((on_tables / "block.h5").read_bytes())
    arrays = {**views.arrays, "image/segmentation": labels}
    (shards / "views.h5").write_bytes(write_shard("views", arrays, views.attributes))
    graspd("export --format dexgraspnet2 -o", tmp_path / "out", shards)
    for folder in (tmp_path / "out" / "data" / "dex_graspness_new").glob("*/realsense"):
        assert sorted(file.name for file in folder.iterdir()) == [f"{view:04}.npy" for view in range(1, 256, 2)]
        assert sample(tmp_path / "out", folder.parent.name, 3, hand).has_graspness


@pytest.fixture
def copied(root: Path, tmp_path: Path) -> tuple[Path, dict]:
    """A file for grasps beside a copy of their scene, and the grasps."""
    (file, *_) = sorted((root / "data" / "dex_grasps_new").rglob("block.npz"))
    scene = Path("data", "scenes", file.parents[1].name)
    shutil.copytree(root / scene, tmp_path / scene)
    copy = tmp_path / file.relative_to(root)
    copy.parent.mkdir(parents=True)
    return copy, load_npz(file)


def test_grasps_of_others_have_no_more_than_their_joints(copied: tuple[Path, dict]) -> None:
    file, whole = copied
    bare = {name: values for name, values in whole.items() if name not in dexgraspnet2._OURS}
    np.savez(file, **bare)
    (back,) = dexgraspnet2.read(file, hand="barrett", obj="block")
    assert back.published is None and len(back.grasps.pregrasp) == len(bare["point"])
    np.savez(file, **bare | {"thumb": np.zeros(len(bare["point"]))})
    with pytest.raises(InputError, match="no joint 'thumb'"):
        dexgraspnet2.read(file, hand="barrett", obj="block")


@pytest.mark.parametrize(
    ("change", "poses", "said"),
    [
        ({"rotation": np.full((3, 3), np.nan)}, None, "pose is not finite"),
        ({"squeeze_qpos": np.zeros((1, 3))}, None, r"squeeze_qpos has the shape \(1, 3\)"),
        ({}, np.zeros((2, 4, 1)), "has no pose of object 0"),
        ({}, np.zeros((3, 4, 1000)), "larger than 64 KiB"),
        ({}, np.zeros(0), "needs its scene"),
    ],
)
def test_grasps_or_a_scene_that_are_none_are_told(change, poses, said: str, copied, tmp_path: Path) -> None:
    np.savez(copied[0], **copied[1] | change)
    meta = next(tmp_path.rglob("0000.mat"))
    if poses is not None:
        scipy.io.savemat(meta, {"poses": poses}) if len(poses) else meta.unlink()
    with pytest.raises(InputError, match=said):
        dexgraspnet2.read(copied[0], hand="barrett", obj="block")


def test_archives_are_neither_unpickled_nor_believed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    np.savez(tmp_path / "x.npz", point=np.array([{"a": 1}], dtype=object))
    with pytest.raises(InputError, match="read safely"):
        load_npz(tmp_path / "x.npz")
    header = b"\x93NUMPY\x01\x00v\x00{'descr': '<f8', 'fortran_order': False, 'shape': (30000000000,), }"
    with zipfile.ZipFile(tmp_path / "x.npz", "w") as archive:
        archive.writestr("point.npy", header.ljust(127) + b"\n")
    with pytest.raises(InputError, match="read safely"):
        load_npz(tmp_path / "x.npz")
    monkeypatch.setattr(dexgraspnet2, "LARGEST", 2**20)
    np.savez_compressed(tmp_path / "x.npz", point=np.zeros(2**20))
    with pytest.raises(InputError, match="unpacks to more"):
        load_npz(tmp_path / "x.npz")


def test_what_shows_no_scene_or_no_clear_grasp_is_told(on_tables: Path, tmp_path: Path, monkeypatch) -> None:
    assert "no picture shows" in refused("export --format dexgraspnet2 -o", tmp_path / "out", on_tables / "block.h5")
    none = PictureReference(0, "base", "views", 0, np.eye(4), IDENTITY_POSE, np.zeros(0, np.intp))
    monkeypatch.setattr(dexgraspnet2, "group_by_scene", lambda pictures: [[none]])
    lots = [SimpleNamespace(id="base")]
    with pytest.raises(InputError, match="no grasp is valid and clear"):
        dexgraspnet2.write(lots, None, tmp_path, frozenset())


def test_more_scenes_than_its_splits_have_numbers_are_told(on_tables: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(dexgraspnet2, "TRAIN", (range(1),))
    assert "2 scenes of objects to train on, but" in refused("export --format dexgraspnet2 -o", tmp_path, on_tables)


@pytest.mark.parametrize(("degrees", "best"), [(4.5, 1), (5.5, 0)])
def test_ten_degrees_weigh_as_fifteen_millimetres(degrees: float, best: int) -> None:
    # The first lies 7.5 mm deeper on the line, which is worth five degrees.
    aside = 0.1 * np.tan(np.radians(degrees))
    assert aim_points(ABOVE, DOWN, np.array([[0, 0, -0.0075], [aside, 0, 0]])).tolist() == [best]
    # Where no point is seen, the nearest one counts.
    assert aim_points(ABOVE, DOWN, np.array([[0.3, 0, 0], [0, 0, 0.12]])).tolist() == [1]


def test_pixels_of_the_object_take_what_is_nearest() -> None:
    """The camera looks at a wall 0.5 m away, its pixels 5 mm apart; right above on the table's x-y."""
    depth = np.full((2, 4), 0.5)
    depth[1, 1] = 0
    labels = np.array([[1, 1, 2, 0], [1, 0, 0, 0]], np.uint8)
    surface = np.array([[-0.005, -0.0025, 0.0], [0.0, -0.0025, 0.0]])
    scene = SceneGraspness(surface, np.array([0]), np.array([1.0, 0.25]))
    ahead = np.array([0, 0, 0.5, 1, 0, 0, 0])
    values = scene.picture_graspness(depth, labels, K, np.eye(4), ahead)
    # Row by row: two of the object, its neighbour, table; the object again, a hole, which is no point, and table.
    assert values.shape == (7, 1)
    np.testing.assert_allclose(values[:, 0], [1, 0.25, 0, 0, 1, 0, 0])
    # An object that stands 13 cm from where the picture shows it is out of reach.
    assert not scene.picture_graspness(depth, labels, K, np.eye(4), ahead + np.array([0, 0, 0.13, 0, 0, 0, 0])).any()


def test_a_hand_looks_between_its_thumb_and_its_fingers(hand, grasps: GraspSet) -> None:
    palm, line = lines_of_sight(hand, grasps.grasp)
    np.testing.assert_allclose(np.linalg.norm(line, axis=1), 1)
    assert palm.shape == (len(grasps.grasp), 3)
    one = replace(hand, fingertips=hand.fingertips[:1])
    still = Posture(IDENTITY_POSE[None], hand.expand(hand.preshape)[None])
    np.testing.assert_allclose(lines_of_sight(one, still)[1], hand.palm.approach[None])
    # A Barrett's fingers meet before its palm.
    assert lines_of_sight(hand, still)[1] @ hand.palm.approach > 0.9


def test_many_grasps_take_no_more_memory(block) -> None:
    surface = surface_samples(block)

    def most(count: int) -> int:
        palm = np.random.default_rng(0).normal(size=(count, 3)) * 0.2
        line = -palm / np.linalg.norm(palm, axis=1, keepdims=True)
        tracemalloc.start()
        sum_graspness(surface, aim_points(palm, line, surface))
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return peak

    assert most(1536) < 1.2 * most(512) < 100 * 2**20
