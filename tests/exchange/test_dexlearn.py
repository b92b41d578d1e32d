"""A folder that DexLearn trains on: each field as its loader reads it, and the grasps as they were. The loader is
rebuilt here from its source, without its draws of chance and without torch.

Mingrui-Yu/DexLearn, dexlearn/dataset/base_dex.py at 2ae1aea3ab5b7360c6e39acd39d04d762bfc8678 (the data set), and its
twin in hugs-dex/HUGS-DexLearn at 95a3c2aa2808ab2e6db0f03d59ceb15cc3c7bebf (`load_scene_cfg` in dexlearn/utils/util.py).

Data that GraspGen trains on, read as its reader and WebDataset do, and hostile files of that kind.

What is read of a record is what `load_object_grasp_datapoint_objaverse` and `GraspWebDatasetReader` of
Kashu7100/GraspGen take (grasp_gen/dataset/dataset_utils.py at a6900321fc57ec8fb96c4a0c879e94f958693513 and
webdataset_utils.py at 07773f7d1307ed0d454b60e7ea1ef38c5a108c0f, copies of NVlabs/GraspGen); its documents
docs/GRASP_DATASET_FORMAT.md and docs/GRIPPER_DESCRIPTION.md say what the frames are.
"""

import io
import json
import re
import shutil
import tarfile
from glob import glob
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import trimesh
import yaml
from scipy.spatial.transform import Rotation

from graspd.exchange import bench_scene, dexgraspbench, dexlearn, graspgen
from graspd.exchange.bench_hand import body_names
from graspd.exchange.plan import held_out_objects, pictures_without_pixels
from graspd.service.model.errors import InputError
from graspd.service.model.transforms import IDENTITY_POSE, apply, invert, pose_to_matrix
from graspd.service.readers import Pictures, open_shards
from graspd.service.readers.clouds import COLUMNS
from graspd.service.readers.depth_noise import parse_depth_noise
from graspd.service.store import validity
from graspd.worker.hands.kinematics import body_poses
from tests.worker.commands_run import graspd, refused
from tests.worker.hands.urdfs import OPENING, gripper

NAME = "graspd_tabletop_graspd_barrett"
#: A pose in float64 through a model in text of 12 digits [m].
ROUNDING_M = 1e-8
#: A point of a picture: depth in float32, and a surface met by a ray in float32 [m].
POINT_M = 2e-5


class Data:
    def __init__(self, root: Path, name: str) -> None:
        said = yaml.safe_load((root / "dexlearn" / "config" / "data" / f"{name}.yaml").read_text())
        self.root, self.config = root, said
        self.grasps = root / said["grasp_path"].replace("${data_folder}", "assets")
        self.objects = root / said["object_path"].replace("${data_folder}", "assets")
        self.types = said["grasp_type_lst"]

    def split(self, name: str) -> list[str]:
        return list(json.loads((self.objects / self.config["split_path"] / f"{name}.json").read_text()))

    def samples(self, split: str) -> list[SimpleNamespace]:
        found = []
        for kind in self.types:
            files = [f for name in self.split(split) for f in _glob(f"{self.grasps}/{kind}/{name}/**/**.npy")]
            assert files, f"{kind} has no object in {split}"
            found += [self._sample(Path(file), kind) for file in sorted(files)]
        return found

    def test_scenes(self) -> list[dict]:
        """What is sampled for: each scene of a held-out object, with its clouds as `clouds`."""
        pattern = self.config["test_scene_cfg"]
        files = [f for name in self.split("test") for f in _glob(f"{self.objects}/scene_cfg/{name}/{pattern}")]
        scenes = [self._scene(Path(file)) for file in files]
        return [scene | {"clouds": self._clouds(scene)} for scene in scenes]

    def _sample(self, file: Path, kind: str) -> SimpleNamespace:
        """Of K grasps: positions (K, 3, 3), rotations (K, 3, 3, 3), joints (K, 3, J); clouds of the first's scale."""
        grasp = np.load(file, allow_pickle=True).item()
        pose = np.stack([grasp["pregrasp_qpos"], grasp["grasp_qpos"], grasp["squeeze_qpos"]], axis=-2)
        assert pose.ndim == 3, "one grasp a file is not implemented there"
        scene = self._scene(self.root / grasp["scene_path"])
        clouds = self._clouds(scene)
        if "scene_scale" in grasp:
            clouds = [cloud * grasp["scene_scale"][0] for cloud in clouds]
        number = int(kind.split("_")[0]) if self.config["grasp_type_cond"] else 0
        turn = Rotation.from_quat(pose[..., 3:7].reshape(-1, 4), scalar_first=True).as_matrix()
        hand = {"hand_trans": pose[..., :3], "hand_rot": turn.reshape(*pose.shape[:-1], 3, 3)}
        hand |= {"hand_joint": pose[..., 7:], "grasp_type_id": number}
        return SimpleNamespace(file=file, clouds=clouds, scene=scene, **hand)

    def _scene(self, file: Path) -> dict:
        scene = np.load(file, allow_pickle=True).item()
        for thing in scene["scene"].values():
            for key in [key for key, value in thing.items() if key.endswith("_path") and isinstance(value, str)]:
                thing[key] = str(file.parent / thing[key])
        return scene

    def _clouds(self, scene: dict) -> list[np.ndarray]:
        files = sorted(_glob(f"{self.objects}/{self.config['pc_path']}/{scene['scene_id']}/partial_pc**.npy"))
        assert files, f"{scene['scene_id']} has no cloud to draw"
        return [np.load(file, allow_pickle=True) for file in files]


def _glob(pattern: str) -> list[str]:
    return glob(pattern, recursive=True)  # noqa: PTH207 (its pattern `**.npy` is none for pathlib)


def test_all_that_may_be_drawn_is_there(checkout: Path) -> None:
    data = Data(checkout, NAME)
    assert data.config["joint_num"] == 8 and data.config["traj_length"] == 3
    assert sorted(data.split("train") + data.split("test")) == ["block", "mug"]
    for split in ("train", "test"):
        for sample in data.samples(split):
            count = len(sample.hand_trans)
            assert sample.hand_trans.shape == (count, 3, 3) and sample.hand_rot.shape == (count, 3, 3, 3)
            assert sample.hand_joint.shape == (count, 3, 8)
            assert all(cloud.ndim == 2 and cloud.shape[1] == 3 and len(cloud) for cloud in sample.clouds)
            assert len(data.types) == 1 or sample.grasp_type_id == int(sample.file.parts[-4].split("_")[0])
    assert data.types and len(data.test_scenes()) == 2


def every(checkout: Path, name: str) -> list[SimpleNamespace]:
    data = Data(checkout, NAME)
    return [one for split in ("train", "test") for one in data.samples(split) if name in one.file.parts]


def test_a_fingertip_stands_where_ours_does(checkout: Path, hand, stored) -> None:
    model = mujoco.MjModel.from_xml_path(str(checkout / "assets" / "hand" / "graspd_barrett" / "hand.xml"))
    state = mujoco.MjData(model)
    tip = hand.fingertips[0]
    rows = []
    for sample in every(checkout, "block"):
        away = invert(sample.scene["scene"]["block"]["pose"])
        record = np.load(sample.file, allow_pickle=True).item()
        for k, row in enumerate(record["row"]):
            rows.append(int(row))
            for when, name in enumerate(dexgraspbench.POSTURES):
                state.qpos[:] = sample.hand_joint[k, when]
                mujoco.mj_kinematics(model, state)
                there = sample.hand_rot[k, when] @ state.body(body_names(hand)[tip]).xpos + sample.hand_trans[k, when]
                posture = (stored[f"{name}/{what}"][row][None] for what in ("hand_pose", "joint_positions"))
                ours = body_poses(hand, *posture)[0, tip, :3]
                np.testing.assert_allclose(apply(away, there), ours, atol=ROUNDING_M)
    assert len(rows) == len(set(rows)) > 0


def test_a_cloud_lies_on_the_object_where_its_scene_has_it(checkout: Path, block) -> None:
    mesh = trimesh.Trimesh(block.vertices, block.faces, process=False)
    for sample in every(checkout, "block"):
        thing = sample.scene["scene"]["block"]
        there = mesh.copy().apply_transform(pose_to_matrix(thing["pose"]))
        np.testing.assert_allclose(trimesh.load(thing["file_path"]).bounds, mesh.bounds, atol=1e-8)  # 9 digits of text
        for cloud in sample.clouds:
            assert len(cloud) > 20
            assert np.abs(trimesh.proximity.closest_point(there, cloud)[1]).max() < POINT_M


def test_a_cloud_of_a_free_object_lies_on_it_where_it_is_itself(on_tables: Path, block) -> None:
    pictures = Pictures(open_shards(on_tables), COLUMNS, valid=False)
    mesh = trimesh.Trimesh(block.vertices, block.faces, process=False)
    seen = [look for look in pictures_without_pixels(pictures) if look.base != "a" * 64]
    assert len(seen) == 4
    for look in seen:
        points = dexlearn.object_points(pictures, look, None, on_table=False)
        assert np.abs(trimesh.proximity.closest_point(mesh, points)[1]).max() < POINT_M
        noisy = dexlearn.object_points(pictures, look, parse_depth_noise("stereo"), on_table=False)
        # A camera is off by some tenths of a millimetre and more, and has holes.
        assert 1e-4 < np.abs(trimesh.proximity.closest_point(mesh, noisy)[1]).max() < 0.05


def test_a_file_is_read_with_its_scene_and_none_from_elsewhere(checkout, tmp_path) -> None:
    copy = tmp_path / "checkout"
    shutil.copytree(checkout, copy)
    (file, *_) = sorted((copy / "assets" / "grasp" / NAME / "succ_collect").rglob("*.npy"))
    record = np.load(file, allow_pickle=True).item()
    pose = record.pop("obj_pose")[0]
    record["scene_scale"] = np.full(len(record["row"]), 0.5)
    bench_scene.save_record(file, record)
    (found,) = dexgraspbench.read(file, hand="barrett", obj="block")
    assert found.placed is not None and found.scale == 0.5
    np.testing.assert_allclose(found.placed.object_pose[0], pose, atol=ROUNDING_M)
    for path in ("/etc/passwd", "assets/../../secret.npy", "other/scene.npy", "assets/none.npy"):
        bench_scene.save_record(tmp_path / "x.npy", record | {"scene_path": path})
        with pytest.raises(InputError, match="no folder above" if path == "assets/none.npy" else "below assets"):
            dexgraspbench.read(tmp_path / "x.npy", hand="barrett", obj="block")


def test_without_pictures_nothing_to_see_is_told(on_tables: Path, tmp_path: Path) -> None:
    said = graspd("export --format dexlearn --all -o", tmp_path / "out", on_tables / "block.h5")
    assert said["clouds"] == 0 and any("no pictures" in note for note in said["notes"])
    assert any("one object" in note for note in said["notes"])


def test_objects_of_the_same_files_are_held_out_together() -> None:
    digests = {"mug": "1", "cup": "1", "bowl": "2", "pan": "3", "pot": "4"}
    for share in (0.01, 0.3, 0.5, 0.99):
        out = held_out_objects(digests, share)
        assert out and out < set(digests) and ("mug" in out) == ("cup" in out)
    assert held_out_objects({"mug": "1", "cup": "1"}, 0.5) == frozenset()


#: JSON gives float64 back as it was; what is left is a quaternion made a matrix [m].
EXACT_M = 1e-12


def record_of(data: Path, uuid: str) -> dict:
    folder = data / "grasps" / "barrett"
    number = json.loads((folder / "uuid_index.json").read_text())[uuid]
    found = []
    with tarfile.open(folder / f"shard_{number:03}.tar") as shard:
        for member in shard:
            # WebDataset's rule: a sample's key ends at the first dot of the name, the rest says what of it a member is.
            parts = re.fullmatch(r"((?:.*/|)[^.]+)[.]([^/]*)", member.name)
            if parts[1] == uuid and parts[2] == "grasps.json":
                found.append(json.loads(shard.extractfile(member).read()))  # type: ignore[union-attr]
    assert len(found) == 1
    return dict(found[0])


def read_back(record: dict, folder: Path):
    (folder / "block.json").write_text(json.dumps(record))
    return graspgen.read(folder / "block.json", hand="barrett", obj="block")


def test_every_object_of_a_split_has_a_record_and_a_mesh(data: Path) -> None:
    splits = [(data / "splits" / "barrett" / f"{name}.txt").read_text().split() for name in ("train", "valid")]
    assert all(splits) and sorted([*splits[0], *splits[1]]) == ["block", "mug"]
    paths = json.loads((data / "objects" / "map_uuid_to_path.json").read_text())
    for uuid in paths:
        assert record_of(data, uuid)["object"] == {"file": paths[uuid], "scale": 1.0}
        assert (data / "objects" / paths[uuid]).is_file()


def test_its_grasps_are_ours_with_their_verdicts(data, hand, block, stored) -> None:
    record = record_of(data, "block")
    poses, mask = np.array(record["grasps"]["transforms"]), np.array(record["grasps"]["object_in_gripper"])
    assert poses.shape == (8, 4, 4) and mask.dtype == bool
    np.testing.assert_array_equal(mask, validity.valid_mask(stored.arrays))
    assert len(poses[mask]) + len(poses[~mask]) == 8
    joints = np.array(record["grasps"]["grasp_joints"])
    tip = hand.fingertips[0]
    in_base = body_poses(hand, np.tile(IDENTITY_POSE, (8, 1)), joints)[:, tip, :3]
    there = np.einsum("nij,nj->ni", poses[:, :3, :3], in_base) + poses[:, :3, 3]
    ours = body_poses(hand, stored["grasp/hand_pose"], stored["grasp/joint_positions"])[:, tip, :3]
    np.testing.assert_allclose(there, ours, atol=EXACT_M)
    mesh = trimesh.load(data / "objects" / record["object"]["file"]).apply_scale(record["object"]["scale"])
    np.testing.assert_allclose(mesh.bounds, [block.vertices.min(0), block.vertices.max(0)], atol=1e-8)


def test_hands_are_turned_into_its_convention_and_jaws_close_along_x(data: Path, hand) -> None:
    said = yaml.safe_load((data / "grippers" / "barrett.yaml").read_text())
    place, turn = said["transform_offset_from_asset_to_graspgen_convention"]
    matrix = Rotation.from_quat(turn).as_matrix()  # x y z w, as SciPy has it
    np.testing.assert_allclose(matrix[:, 2], hand.palm.approach, atol=1e-12)
    assert place == [0, 0, 0] and said["width"] > 0.05 and said["depth"] > 0.02
    said = graspgen.gripper_convention(gripper())
    turn = Rotation.from_quat(said["transform_offset_from_asset_to_graspgen_convention"][1]).as_matrix()
    assert np.abs(turn[:, 0]) == pytest.approx([1, 0, 0], abs=1e-9) and turn[:, 2] == pytest.approx([0, 0, 1], abs=1e-9)
    assert said["width"] == pytest.approx(OPENING, abs=1e-5)
    # The pads reach from 70 to 110 mm in front of the base link.
    assert 0.07 < said["depth"] < 0.11


def test_of_grasps_without_joints_fingers_close_until_they_touch(data: Path, hand, tmp_path: Path) -> None:
    record = record_of(data, "block")
    del record["gripper"]
    (back,) = read_back(record, tmp_path)
    opened = np.abs(back.grasps.pregrasp.joint_positions - back.grasps.grasp.joint_positions).max(axis=1)
    assert (opened > 0.01).all() and len(back.grasps) == 8
    assert (np.abs(hand.reduce(back.grasps.grasp.joint_positions) - hand.preshape).max(axis=1) > 0.05).all()


def test_an_object_among_several_is_named(data: Path) -> None:
    for name in ("", "cup"):
        with pytest.raises(InputError, match="block, mug"):
            graspgen.read(data / "grasps" / "barrett", hand="barrett", obj="block", object_name=name)


def test_what_nobody_validated_has_no_label(on_tables: Path, tmp_path: Path) -> None:
    assert "needs a verdict" in refused("export --format graspgen --unvalidated -o", tmp_path / "out", on_tables)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"transforms": [np.zeros((4, 4)).tolist()] * 8}, "not poses"),
        ({"transforms": [np.diag([1.0, 1, -1, 1]).tolist()] * 8}, "not poses"),
        ({"transforms": [[1, 2], [3]]}, "no record"),
        ({"object_in_gripper": [True]}, "shape"),
        ({"squeeze_pose": [[0, 0, 0, 1, 0, 0, 0]]}, "numbers of pregrasps"),
        *[({"scale": scale}, "has an object of scale") for scale in (0, -1, "inf", "nan")],
    ],
)
def test_a_record_that_is_wrong_is_told(data: Path, tmp_path: Path, change: dict, said: str) -> None:
    record = record_of(data, "block")
    record["object" if "scale" in change else "grasps"] |= change
    with pytest.raises(InputError, match=said):
        read_back(record, tmp_path)


def test_links_compressed_and_large_files_are_not_followed(data: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(graspgen, "LARGEST", 1000)
    with pytest.raises(InputError, match="larger than"):
        graspgen.read(data / "grasps" / "barrett", hand="barrett", obj="block", object_name="block")
    link = tarfile.TarInfo("block.grasps.json")
    link.type, link.linkname = tarfile.SYMTYPE, "/etc/passwd"
    with tarfile.open(tmp_path / "links.tar", "w") as tar:
        tar.addfile(link)
    with pytest.raises(InputError, match="it has none"):
        graspgen.read(tmp_path / "links.tar", hand="barrett", obj="block")
    with tarfile.open(tmp_path / "packed.tar", "w:gz") as tar:
        tar.addfile(tarfile.TarInfo("block.grasps.json"), io.BytesIO())
    with pytest.raises(InputError, match="no tar file"):
        graspgen.read(tmp_path / "packed.tar", hand="barrett", obj="block")
