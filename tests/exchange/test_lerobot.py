"""LeRobot data sets: tables and videos as LeRobot's readers take them, episodes as they were recorded.

huggingface/lerobot, src/lerobot/datasets/dataset_metadata.py at 000c716dee659050ca18aac456316325302d937c,
dataset_reader.py at 0201803db23ee42ed1952e84f8ed9d6ab1eb3b92 and io_utils.py at
073c4dbda9a9827b01abbd71ffbdc42580b23b72.
"""

import io
import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

from graspd.service.store.shards import inherited_attributes, read_shard, write_shard
from graspd.worker.episodes.episode import Episode, EpisodeOutcome
from graspd.worker.episodes.shard import episodes_of_shard
from graspd.worker.objects.prepare import object_from_path
from tests.worker.commands_run import graspd, refused

av = pytest.importorskip("av", reason="PyAV is not installed; pip install 'graspd[film]'")
pq = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed; pip install 'graspd[parquet]'")
CAMERAS = ("scene", "wrist")


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with filmed episodes of a block, and the same as of a mug: one of them failed."""
    folder = tmp_path_factory.mktemp("episodes") / "shards"
    folder.mkdir()
    graspd("synth --hand barrett --object block --scene table -n 2 --fidelity draft -o", folder.with_name("block.h5"))
    films = "--film scene,wrist --size 64x48 -o"
    assert graspd(f"episodes create {films}", folder / "block.h5", folder.with_name("block.h5"))["succeeded"] == 2
    rewrite(
        folder / "block.h5",
        folder / "mug.h5",
        {"episode/outcome": np.array([EpisodeOutcome.NOT_LIFTED, 0], np.uint8)},
        object="mug",
        object_digest=object_from_path("mug").digest,
        requirements='{"touch_region": "part handle"}',
        shard_id="a" * 64,
    )
    return folder


def rewrite(source: Path, file: Path, columns: dict | None = None, **attributes: object) -> None:
    shard = read_shard(source, kind="episodes")
    said = inherited_attributes(shard) | {"shard_id": shard.attributes["shard_id"]} | attributes
    file.write_bytes(write_shard("episodes", shard.arrays | (columns or {}), said))


@pytest.fixture(scope="module")
def recorded(shards: Path) -> Path:
    folder = shards.with_name("recorded")
    told = graspd("export --format lerobot --all -o", folder, shards)
    assert told["episodes"] == 4 and told["tasks"] == len(tasks(folder)) >= 2
    return folder


def info(recorded: Path) -> dict:
    return json.loads((recorded / "meta" / "info.json").read_text())


def tasks(recorded: Path) -> dict[int, str]:
    return {row["task_index"]: row["task"] for row in pq.read_table(recorded / "meta" / "tasks.parquet").to_pylist()}


def rows(recorded: Path, folder: str) -> list[dict]:
    return [row for file in sorted((recorded / folder).glob("*/*.parquet")) for row in pq.read_table(file).to_pylist()]


def pictures(video: Path | io.BytesIO) -> np.ndarray:
    with av.open(video) as source:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in source.decode(video=0)])


def originals(recorded: Path, shards: Path) -> list[tuple[dict, Episode]]:
    """Each listed episode, and the one of the shard."""
    names = {read_shard(file, kind="episodes").attributes["shard_id"]: file for file in shards.iterdir()}
    found = []
    for episode in rows(recorded, "meta/episodes"):
        stored = episodes_of_shard(read_shard(names[episode["graspd/shard"]], kind="episodes"))
        (one,) = (one for one in stored if one.row == episode["graspd/row"])
        found.append((episode, one))
    return found


def test_info_says_what_is_there_and_pandas_finds_the_tasks(recorded: Path) -> None:
    told, frames = info(recorded), rows(recorded, "data")
    assert told["codebase_version"] == "v3.0" and told["fps"] == 15 and told["robot_type"] == "barrett"
    assert told["total_frames"] == len(frames) and told["total_episodes"] == len(rows(recorded, "meta/episodes")) == 4
    assert told["splits"] == {"train": "0:2", "test": "2:4"}
    videos = {name for name, feature in told["features"].items() if feature["dtype"] == "video"}
    assert videos == {f"observation.images.{camera}" for camera in CAMERAS}
    assert set(frames[0]) == set(told["features"]) - videos
    assert not any("/" in name for name in told["features"])  # LeRobot takes / for a level of statistics
    about = json.loads(pq.read_schema(recorded / "meta" / "tasks.parquet").metadata[b"pandas"])
    assert about["index_columns"] == ["task"]


def test_each_episode_lies_where_the_list_says(recorded: Path, shards: Path) -> None:
    told, frames, words = info(recorded), rows(recorded, "data"), tasks(recorded)
    for episode, one in originals(recorded, shards):
        some = frames[episode["dataset_from_index"] : episode["dataset_to_index"]]
        count = len(one.state)
        assert episode["length"] == len(some) == count
        assert {row["episode_index"] for row in some} == {episode["episode_index"]}
        assert [row["index"] for row in some] == list(range(episode["dataset_from_index"], episode["dataset_to_index"]))
        assert [row["frame_index"] for row in some] == list(range(count))
        np.testing.assert_allclose([row["timestamp"] for row in some], np.arange(count) / 15, atol=1e-6)
        assert {words[row["task_index"]] for row in some} == set(episode["tasks"])
        for name, values in (("observation.state", one.state), ("action", one.action)):
            np.testing.assert_array_equal([row[name] for row in some], values)  # both are float32
        np.testing.assert_array_equal([row["observation.environment_state"] for row in some], one.object_pose)
        succeeded = one.outcome is EpisodeOutcome.SUCCEEDED
        assert [row["next.success"] for row in some] == [False] * (count - 1) + [succeeded]
        assert episode["graspd/outcome"] == one.outcome.name.lower()
        for camera in CAMERAS:
            key = f"videos/observation.images.{camera}"
            place = {name: episode[f"{key}/{name}"] for name in ("chunk_index", "file_index")}
            path = recorded / told["video_path"].format(video_key=key.removeprefix("videos/"), **place)
            first, end = (round(15 * episode[f"{key}/{name}_timestamp"]) for name in ("from", "to"))
            # Packets are copied, so pictures are equal.
            np.testing.assert_array_equal(pictures(path)[first:end], pictures(io.BytesIO(one.videos[camera])))


def test_a_task_has_object_part_and_type_in_words(recorded: Path, shards: Path) -> None:
    words = {"power": 1, "precision": 2, "lateral": 3}
    for episode in rows(recorded, "meta/episodes"):
        what, _, how = episode["tasks"][0].partition(" with a ")
        assert what == ("pick the mug by its handle" if episode["graspd/shard"] == "a" * 64 else "pick the block")
        assert words.get(how.removesuffix(" grasp"), 0) == episode["graspd/grasp_type"]


def test_statistics_are_those_of_the_frames(recorded: Path) -> None:
    stats, frames = json.loads((recorded / "meta" / "stats.json").read_text()), rows(recorded, "data")
    assert set(stats) == set(info(recorded)["features"])
    for name in ("action", "observation.state"):
        values = np.array([row[name] for row in frames], float)
        np.testing.assert_allclose(stats[name]["mean"], values.mean(axis=0), atol=1e-12)
        np.testing.assert_allclose(stats[name]["q90"], np.quantile(values, 0.9, axis=0), atol=1e-12)
        assert stats[name]["count"] == [len(frames)]
    for camera in CAMERAS:
        seen = pictures(recorded / f"videos/observation.images.{camera}/chunk-000/file-000.mp4")
        found = np.array(stats[f"observation.images.{camera}"]["mean"])
        assert found.shape == (3, 1, 1)
        # A tenth of the pixels of key frames, which are every tenth.
        np.testing.assert_allclose(found[:, 0, 0], seen.reshape(-1, 3).mean(axis=0) / 255, atol=0.03)


def test_failed_episodes_need_an_option(shards: Path, tmp_path: Path) -> None:
    assert graspd("export --format lerobot -o", tmp_path / "out", shards)["episodes"] == 3
    assert "holds a data set already" in refused("export --format lerobot -o", tmp_path / "out", shards)


@pytest.mark.parametrize(
    ("words", "change"),
    [
        ("one robot, rate and set of cameras", {"fps": 20}),
        ("one robot, rate and set of cameras", {"cameras": "{}"}),
        ("no successful episode", None),
    ],
)
def test_what_is_no_data_set_is_refused(words: str, change: dict | None, shards: Path, tmp_path: Path) -> None:
    folder = tmp_path / "shards"
    folder.mkdir()
    source = shards / "block.h5"
    failed = {"episode/outcome": np.full(2, EpisodeOutcome.DROPPED, np.uint8)}
    rewrite(source, folder / "first.h5", failed if change is None else None)
    if change is not None:
        rewrite(source, folder / "second.h5", shard_id="b" * 64, **change)
    assert words in refused("export --format lerobot -o", tmp_path / "out", folder)


ITERATED = """
import sys
from lerobot.datasets.lerobot_dataset import LeRobotDataset
data = LeRobotDataset("graspd/test", root=sys.argv[1], video_backend="pyav")
frames = [data[k] for k in range(len(data))]
assert {tuple(one["observation.images.wrist"].shape) for one in frames} == {(3, 48, 64)}
print(data.num_episodes, len(frames), frames[0]["task"])
"""


@pytest.mark.slow
def test_the_package_itself_iterates_over_frames_and_its_linter_finds_no_fault(recorded: Path) -> None:
    """`LEROBOT_PYTHON` is the Python of an environment with lerobot 0.4 and lerobot-doctor."""
    if not (python := os.environ.get("LEROBOT_PYTHON")):
        pytest.skip("LEROBOT_PYTHON names no Python with lerobot and lerobot-doctor")
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"} | {"HF_HUB_OFFLINE": "1"}

    def run(*words: str) -> str:
        done = subprocess.run([python, *words, str(recorded)], capture_output=True, text=True, env=clean, timeout=240)
        assert done.returncode == 0, done.stderr[-2000:] + done.stdout[-2000:]
        return done.stdout

    told = info(recorded)
    assert run("-c", ITERATED).startswith(f"4 {told['total_frames']} pick the ")
    assert "FAIL" not in run("-m", "lerobot_doctor.cli")
