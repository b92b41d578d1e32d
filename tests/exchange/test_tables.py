"""Data sets of tables for Hugging Face's `datasets`: each file as its readers take it, grasps as they were."""

import io
import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

from graspd.exchange import huggingface
from graspd.service.model.transforms import apply, compose, pose_from_matrix
from graspd.service.readers import Pictures, open_shards
from graspd.worker.hands.kinematics import body_poses

pq = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed; pip install 'graspd[parquet]'")
#: Poses in float64 from one frame into another [m].
ROUNDING_M = 1e-12


def configs(folder: Path) -> dict[str, dict[str, list[Path]]]:
    head = yaml.safe_load((folder / "README.md").read_text().split("---")[1])
    return {
        one["config_name"]: {part["split"]: sorted(folder.glob(part["path"])) for part in one["data_files"]}
        for one in head["configs"]
    }


def rows_of(folder: Path, table: str, name: str) -> list[dict]:
    files = [file for split in configs(folder)[table].values() for file in split]
    return [row for file in files for row in pq.read_table(file).to_pylist() if row["object"] == name]


def picture(cell: dict) -> np.ndarray:
    assert cell["path"] is None
    return np.array(Image.open(io.BytesIO(cell["bytes"])))


def test_its_card_names_all_files_and_columns_of_pictures(folder: Path) -> None:
    found = configs(folder)
    splits = ["test", "train"]
    assert {table: sorted(parts) for table, parts in found.items()} == {"grasps": splits, "pictures": splits}
    files = [file for parts in found.values() for part in parts.values() for file in part]
    assert sorted(files) == sorted(folder.rglob("*.parquet"))
    for file in (folder / "pictures").iterdir():
        told = json.loads(pq.read_schema(file).metadata[b"huggingface"])["info"]["features"]
        assert told == {name: {"_type": "Image"} for name in ("rgb", "depth", "segmentation")}


def test_a_row_is_a_grasp_of_ours(folder: Path, stored, hand) -> None:
    rows = rows_of(folder, "grasps", "block")
    assert sorted(row["row"] for row in rows) == list(range(8))
    for row in rows:
        assert row["joint_names"] == list(hand.joint_names) and row["scene_kind"] == "table"
        assert row["verdict"] == stored["quality/success"][row["row"]]
        assert row["object_pose"] == stored["scene/object_pose"][row["scene"]].tolist()
        for name in huggingface.POSTURES:
            assert row[f"{name}_pose"] == stored[f"{name}/hand_pose"][row["row"]].tolist()
            assert row[f"{name}_joints"] == stored[f"{name}/joint_positions"][row["row"]].tolist()


def test_picture_has_what_was_seen_and_fingertips_where_they_are(folder, on_tables, hand, stored) -> None:
    pictures = Pictures(open_shards(on_tables), valid=False)
    ours = {(one["object"], one["row"]): one for one in pictures}
    tip = hand.fingertips[0]
    for row in rows_of(folder, "pictures", "block"):
        seen = ours["block", row["row"]]
        np.testing.assert_array_equal(picture(row["rgb"]), seen["image/rgb"])
        np.testing.assert_array_equal(picture(row["segmentation"]), seen["image/segmentation"])
        depth = picture(row["depth"])
        assert depth.dtype == np.uint16
        there = np.isfinite(seen["image/depth"])
        # Half a step of 0.1 mm, and float32 of a metre.
        np.testing.assert_allclose(depth[there] * 1e-4, seen["image/depth"][there], atol=5.1e-5)
        np.testing.assert_array_equal(row["intrinsics"], seen["camera/intrinsics"])
        camera = pose_from_matrix(np.array(row["extrinsics"]))
        if not row["grasp_rows"]:
            continue
        tips = body_poses(hand, np.array(row["hand_poses"]), np.array(row["joint_positions"]))[:, tip, :3]
        some = np.array(row["grasp_rows"])
        at = compose(stored["scene/object_pose"][row["scene"]], stored["grasp/hand_pose"][some])
        on_table = body_poses(hand, at, stored["grasp/joint_positions"][some])[:, tip, :3]
        np.testing.assert_allclose(tips, apply(camera, on_table), atol=ROUNDING_M * 1e3)


def test_the_package_itself_reads_the_folder(folder: Path, tmp_path: Path, stored) -> None:
    datasets = pytest.importorskip("datasets", reason="`pip install datasets` runs this test")
    grasps = datasets.load_dataset(str(folder), "grasps", cache_dir=str(tmp_path))
    assert sum(len(split) for split in grasps.values()) == 16
    pictures = datasets.load_dataset(str(folder), "pictures", cache_dir=str(tmp_path))
    assert np.array(pictures["train"][0]["rgb"]).shape == (72, 96, 3)
