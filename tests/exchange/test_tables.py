"""Data sets of tables: Hugging Face's `datasets` and LeRobot, each file as their readers take it, grasps as they were.

huggingface/lerobot, src/lerobot/datasets/dataset_metadata.py at 000c716dee659050ca18aac456316325302d937c,
dataset_reader.py at 0201803db23ee42ed1952e84f8ed9d6ab1eb3b92 and io_utils.py at
073c4dbda9a9827b01abbd71ffbdc42580b23b72.
"""

import io
import itertools
import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from PIL import Image

from graspd.exchange import huggingface, lerobot
from graspd.service.model.errors import InputError
from graspd.service.model.transforms import apply, compose, pose_from_matrix
from graspd.service.readers import Pictures, open_shards
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import hand_from_path
from tests.worker.commands_run import graspd, refused

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


#: Joints and roots are float32 there: 6e-8 of a radian or metre, along a finger of 0.2 m and a chain of 4 [m].
FLOAT32_M = 1e-6


def frames(recorded: Path) -> list[dict]:
    info = json.loads((recorded / "meta" / "info.json").read_text())
    rows = []
    for file in sorted((recorded / "data").glob("*/*.parquet")):
        table = pq.read_table(file)
        assert set(table.column_names) == set(info["features"])
        rows += table.to_pylist()
    for row in rows:
        for name, feature in info["features"].items():
            if feature["dtype"] == "image":
                row[name] = picture(row[name])
                assert list(row[name].shape) == feature["shape"]
            elif feature["shape"] != [1]:
                assert len(row[name]) == feature["shape"][0] == len(feature["names"])
    return rows


def episodes(recorded: Path) -> list[dict]:
    files = sorted((recorded / "meta" / "episodes").glob("*/*.parquet"))
    rows = [row for file in files for row in pq.read_table(file).to_pylist()]
    return sorted(rows, key=lambda row: row["episode_index"])


def test_info_says_what_is_there_and_pandas_finds_the_tasks(recorded: Path) -> None:
    info = json.loads((recorded / "meta" / "info.json").read_text())
    assert info["codebase_version"] == "v3.0" and info["fps"] > 0 and info["chunks_size"] > 0
    assert info["total_frames"] == len(frames(recorded)) and info["total_episodes"] == len(episodes(recorded)) == 16
    ends = {name: [int(end) for end in span.split(":")] for name, span in info["splits"].items()}
    assert ends["train"][0] == 0 and ends["train"][1] == ends["test"][0] and ends["test"][1] == 16
    assert not any("/" in name for name in info["features"])  # it takes / for a level of statistics
    told = json.loads(pq.read_schema(recorded / "meta" / "tasks.parquet").metadata[b"pandas"])
    assert told["index_columns"] == ["task"]
    assert {column["field_name"] for column in told["columns"]} == {"task", "task_index"}


def test_each_episode_lies_where_the_list_says(recorded: Path) -> None:
    info, rows = json.loads((recorded / "meta" / "info.json").read_text()), frames(recorded)
    tasks = {row["task_index"]: row["task"] for row in pq.read_table(recorded / "meta" / "tasks.parquet").to_pylist()}
    for episode in episodes(recorded):
        some = rows[episode["dataset_from_index"] : episode["dataset_to_index"]]
        place = {"chunk_index": episode["data/chunk_index"], "file_index": episode["data/file_index"]}
        assert (recorded / info["data_path"].format(**place)).is_file()
        assert [row["episode_index"] for row in some] == [episode["episode_index"]] * episode["length"]
        assert [row["index"] for row in some] == list(range(episode["dataset_from_index"], episode["dataset_to_index"]))
        assert [row["frame_index"] for row in some] == list(range(episode["length"]))
        # Its check of times: frame over fps to within 0.1 ms.
        np.testing.assert_allclose([row["timestamp"] for row in some], np.arange(len(some)) / info["fps"], atol=1e-4)
        assert {tasks[row["task_index"]] for row in some} == set(episode["tasks"])


def test_statistics_are_those_of_the_frames(recorded: Path) -> None:
    stats, rows = json.loads((recorded / "meta" / "stats.json").read_text()), frames(recorded)
    assert set(stats) == set(json.loads((recorded / "meta" / "info.json").read_text())["features"])
    for name in ("action", "observation.state"):
        values = np.array([row[name] for row in rows], float)
        np.testing.assert_allclose(stats[name]["mean"], values.mean(axis=0), atol=1e-12)
        np.testing.assert_allclose(stats[name]["q90"], np.quantile(values, 0.9, axis=0), atol=1e-12)
        assert stats[name]["count"] == [len(rows)]
    picture = np.array(stats["observation.images.scene"]["mean"])
    assert picture.shape == (3, 1, 1)
    mean = np.mean([row["observation.images.scene"].reshape(-1, 3).mean(axis=0) for row in rows], axis=0) / 255
    np.testing.assert_allclose(picture[:, 0, 0], mean, atol=0.02)  # of a tenth of the pixels


def test_an_episode_is_the_way_of_its_grasp(recorded: Path, on_tables: Path, hand, stored) -> None:
    pictures = [one for one in Pictures(open_shards(on_tables)) if one["object"] == "block"]
    rows, tip = frames(recorded), hand.fingertips[0]
    mine = [episode for episode in episodes(recorded) if episode["tasks"] == ["lift the block"]]
    assert sorted(episode["graspd/row"] for episode in mine) == list(range(8))
    for episode in mine:
        some = rows[episode["dataset_from_index"] : episode["dataset_to_index"]]
        row = episode["graspd/row"]
        scene = int(stored["grasp/scene_index"][row])
        rest = stored["scene/object_pose"][scene]
        np.testing.assert_allclose(some[0]["observation.environment_state"], rest, atol=FLOAT32_M)
        for here, after in itertools.pairwise(some):
            assert here["action"] == after["observation.state"]
        for state, name in ((some[-2]["observation.state"], "grasp"), (some[-1]["observation.state"], "squeeze")):
            state = np.array(state)
            pose = compose(rest, stored[f"{name}/hand_pose"][row])
            ours = body_poses(hand, pose[None], stored[f"{name}/joint_positions"][row][None])[0, tip, :3]
            there = body_poses(hand, state[None, :7], state[None, 7:])[0, tip, :3]
            np.testing.assert_allclose(there, ours, atol=FLOAT32_M)
        raised = np.array(some[-1]["action"]) - some[-1]["observation.state"]
        np.testing.assert_allclose(raised[:3], [0, 0, 0.1], atol=FLOAT32_M)
        seen = [one["image/rgb"] for one in pictures if one["scene"] == scene]
        assert any(np.array_equal(some[0]["observation.images.scene"], one) for one in seen)


def test_grasps_without_pictures_or_with_pictures_of_several_sizes_are_refused(on_tables: Path, tmp_path: Path) -> None:
    assert "no picture shows" in refused("export --format lerobot --all -o", tmp_path / "out", on_tables / "block.h5")
    shards = tmp_path / "shards"
    shutil.copytree(on_tables, shards, ignore=shutil.ignore_patterns("block-views.h5"))
    graspd("render --views 1 --width 48 --height 36 -o", shards / "block-views.h5", shards / "block.h5")
    assert "do not fit into one" in refused("export --format lerobot --all -o", tmp_path / "out", shards)


@pytest.mark.parametrize(("hands", "said"), [(["barrett"], "--scene table"), (["barrett", "allegro"], "several hands")])
def test_free_grasps_or_two_hands_are_no_data_set(hands: list[str], said: str, tmp_path: Path) -> None:
    lots = [SimpleNamespace(hand=hand_from_path(name), name="block", placed=None) for name in hands]
    with pytest.raises(InputError, match=said):
        lerobot.write(lots, None, tmp_path, frozenset())
