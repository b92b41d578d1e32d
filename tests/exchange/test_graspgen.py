"""Data that GraspGen trains on, read as its reader and WebDataset do, and hostile files of that kind.

What is read of a record is what `load_object_grasp_datapoint_objaverse` and `GraspWebDatasetReader` of
Kashu7100/GraspGen take (grasp_gen/dataset/dataset_utils.py at a6900321fc57ec8fb96c4a0c879e94f958693513 and
webdataset_utils.py at 07773f7d1307ed0d454b60e7ea1ef38c5a108c0f, copies of NVlabs/GraspGen); its documents
docs/GRASP_DATASET_FORMAT.md and docs/GRIPPER_DESCRIPTION.md say what the frames are.
"""

import io
import json
import re
import tarfile
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
from scipy.spatial.transform import Rotation

from graspd.exchange import graspgen
from graspd.service.model.errors import InputError
from graspd.service.model.transforms import IDENTITY_POSE
from graspd.service.store import validity
from graspd.worker.hands.kinematics import body_poses
from tests.worker.commands_run import refused
from tests.worker.hands.urdfs import OPENING, gripper

#: JSON gives float64 back as it was; what is left is a quaternion made a matrix [m].
ROUNDING_M = 1e-12


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
    np.testing.assert_allclose(there, ours, atol=ROUNDING_M)
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
