"""A data set that LeRobot reads: each file as its reader takes it, and the ways of the grasps as they were.

huggingface/lerobot, src/lerobot/datasets/dataset_metadata.py at 000c716dee659050ca18aac456316325302d937c,
dataset_reader.py at 0201803db23ee42ed1952e84f8ed9d6ab1eb3b92 and io_utils.py at
073c4dbda9a9827b01abbd71ffbdc42580b23b72.
"""

import io
import itertools
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from graspd.exchange import lerobot
from graspd.service.model.errors import InputError
from graspd.service.model.transforms import compose
from graspd.service.readers import Pictures, open_shards
from graspd.worker.hands.kinematics import body_poses
from tests.worker.commands_run import refused

pq = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed; pip install 'graspd[parquet]'")
#: Joints and roots are float32 there: 6e-8 of a radian or metre, along a finger of 0.2 m and a chain of 4 [m].
FLOAT32_M = 1e-6


@pytest.fixture(scope="module")
def root(exported) -> Path:
    return exported("lerobot")


def frames(root: Path) -> list[dict]:
    """All frames in the order of their files, as the reader joins them, cast to the features of `info.json`."""
    info = json.loads((root / "meta" / "info.json").read_text())
    rows = []
    for file in sorted((root / "data").glob("*/*.parquet")):
        table = pq.read_table(file)
        assert set(table.column_names) == set(info["features"])
        rows += table.to_pylist()
    for row in rows:
        for name, feature in info["features"].items():
            if feature["dtype"] == "image":
                with Image.open(io.BytesIO(row[name]["bytes"])) as image:
                    row[name] = np.array(image)
                assert list(row[name].shape) == feature["shape"]
            elif feature["shape"] != [1]:
                assert len(row[name]) == feature["shape"][0] == len(feature["names"])
    return rows


def episodes(root: Path) -> list[dict]:
    files = sorted((root / "meta" / "episodes").glob("*/*.parquet"))
    rows = [row for file in files for row in pq.read_table(file).to_pylist()]
    return sorted(rows, key=lambda row: row["episode_index"])


def test_info_says_what_is_there_and_pandas_finds_the_tasks(root: Path) -> None:
    info = json.loads((root / "meta" / "info.json").read_text())
    assert info["codebase_version"] == "v3.0" and info["fps"] > 0 and info["chunks_size"] > 0
    assert info["total_frames"] == len(frames(root)) and info["total_episodes"] == len(episodes(root)) == 16
    ends = {name: [int(end) for end in span.split(":")] for name, span in info["splits"].items()}
    assert ends["train"][0] == 0 and ends["train"][1] == ends["test"][0] and ends["test"][1] == 16
    assert not any("/" in name for name in info["features"])  # it takes / for a level of statistics
    told = json.loads(pq.read_schema(root / "meta" / "tasks.parquet").metadata[b"pandas"])
    assert told["index_columns"] == ["task"]
    assert {column["field_name"] for column in told["columns"]} == {"task", "task_index"}


def test_each_episode_lies_where_the_list_says(root: Path) -> None:
    info, rows = json.loads((root / "meta" / "info.json").read_text()), frames(root)
    tasks = {row["task_index"]: row["task"] for row in pq.read_table(root / "meta" / "tasks.parquet").to_pylist()}
    for episode in episodes(root):
        some = rows[episode["dataset_from_index"] : episode["dataset_to_index"]]
        place = {"chunk_index": episode["data/chunk_index"], "file_index": episode["data/file_index"]}
        assert (root / info["data_path"].format(**place)).is_file()
        assert [row["episode_index"] for row in some] == [episode["episode_index"]] * episode["length"]
        assert [row["index"] for row in some] == list(range(episode["dataset_from_index"], episode["dataset_to_index"]))
        assert [row["frame_index"] for row in some] == list(range(episode["length"]))
        # Its check of times: frame over fps to within 0.1 ms.
        np.testing.assert_allclose([row["timestamp"] for row in some], np.arange(len(some)) / info["fps"], atol=1e-4)
        assert {tasks[row["task_index"]] for row in some} == set(episode["tasks"])


def test_statistics_are_those_of_the_frames(root: Path) -> None:
    stats, rows = json.loads((root / "meta" / "stats.json").read_text()), frames(root)
    info = json.loads((root / "meta" / "info.json").read_text())
    assert set(stats) == set(info["features"])
    for name in ("action", "observation.state"):
        values = np.array([row[name] for row in rows], float)
        np.testing.assert_allclose(stats[name]["mean"], values.mean(axis=0), atol=1e-12)
        np.testing.assert_allclose(stats[name]["q90"], np.quantile(values, 0.9, axis=0), atol=1e-12)
        assert stats[name]["count"] == [len(rows)]
    picture = np.array(stats["observation.images.scene"]["mean"])
    assert picture.shape == (3, 1, 1)
    mean = np.mean([row["observation.images.scene"].reshape(-1, 3).mean(axis=0) for row in rows], axis=0) / 255
    np.testing.assert_allclose(picture[:, 0, 0], mean, atol=0.02)  # of a tenth of the pixels


def test_an_episode_is_the_way_of_its_grasp(root: Path, on_tables: Path, hand, stored) -> None:
    pictures = [one for one in Pictures(open_shards(on_tables)) if one["object"] == "block"]
    rows, tip = frames(root), hand.fingertips[0]
    mine = [episode for episode in episodes(root) if episode["tasks"] == ["lift the block"]]
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


def test_grasps_come_back_with_their_ways(root: Path, stored) -> None:
    (back,) = lerobot.read(root, hand="barrett", obj="block", object_name="block")
    assert back.grasps.approach is not None and back.grasps.lift is not None
    np.testing.assert_allclose(back.grasps.approach[..., :3], stored["grasp/approach"][..., :3], atol=FLOAT32_M)
    np.testing.assert_allclose(back.grasps.lift.hand_pose[:, :3], stored["grasp/lift"][:, :3], atol=FLOAT32_M)


def test_a_data_set_of_somebody_else_is_told(root: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    shutil.copytree(root, other)
    info = json.loads((other / "meta" / "info.json").read_text())
    info["features"]["observation.state"]["names"] = ["shoulder", "elbow"]
    (other / "meta" / "info.json").write_text(json.dumps(info))
    with pytest.raises(InputError, match="was not exported by graspd"):
        lerobot.read(other, hand="barrett", obj="block", object_name="block")
    with pytest.raises(InputError, match="lift the block, lift the mug"):
        lerobot.read(root, hand="barrett", obj="block", object_name="cup")


def test_grasps_without_pictures_are_no_episodes(on_tables: Path, tmp_path: Path) -> None:
    said = refused("export --format lerobot --all -o", tmp_path / "out", on_tables / "block.h5")
    assert "no picture shows" in said
