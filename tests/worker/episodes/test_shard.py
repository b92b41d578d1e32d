"""Files of episodes: `graspd episodes create` and `replay` on grasps of a block with another one beside it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from graspd.service.model.transforms import quat_from_axis_angle, quat_multiply
from graspd.service.store.columns import Attribute
from graspd.service.store.shards import inherited_attributes, read_shard, write_shard
from graspd.worker.episodes.episode import Episode, Robot
from graspd.worker.episodes.shard import (
    EpisodeOptions,
    episodes_of_shard,
    record_episodes,
    replay_episodes,
    robot_of_shard,
)
from graspd.worker.episodes.simulation import Simulation
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.files.provenance import hand_of_shard, object_of_shard, scenes_of_shard
from graspd.worker.validation.decomposition import decompose
from tests.worker.commands_run import graspd, refused

PAIR = "synth --hand barrett --object block --fidelity draft --seed 3"


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("episodes") / "table.h5"
    graspd(f"{PAIR} --scene table --with block --scenes 2 -n 3 -o", file)
    return file


def create(table: Path, words: str = "", name: str = "episodes.h5") -> tuple[dict, Path]:
    return graspd(f"episodes create {words} -o", table.with_name(name), table), table.with_name(name)


def rewrite(file: Path, name: str, **change: np.ndarray | Attribute) -> Path:
    """A copy of a file of episodes with other columns or attributes; `__` stands for the stroke in a column's name."""
    shard, out = read_shard(file, kind="episodes"), file.with_name(name)
    change = {key.replace("__", "/"): value for key, value in change.items()}
    columns = {key: value for key, value in change.items() if "/" in key}
    attributes = {key: value for key, value in change.items() if "/" not in key}
    out.write_bytes(write_shard("episodes", shard.arrays | columns, inherited_attributes(shard) | attributes))
    return out


@pytest.mark.parametrize("arm", ["", "--arm franka"])
def test_a_replay_of_the_file_repeats_every_frame(table: Path, arm: str) -> None:
    told, file = create(table, f"{arm} --fps 20 --seed 5")
    shard = read_shard(file, kind="episodes")
    assert told["executed"] == told["succeeded"] == 3 and told["outcomes"] == {"succeeded": 3}
    assert shard["frame/neighbour_pose"].shape == (told["frames"], 1, 7)
    assert shard.attributes["fps"] == 20 and shard.attributes["base_shard"]
    assert shard["quality/grasp_type"].tolist() == read_shard(table)["quality/grasp_type"].tolist()
    assert shard.attributes["state_names"] == list(robot_of_shard(shard, hand_of_shard(shard, None)).names)
    assert graspd("episodes replay", file) == {"file": str(file), "episodes": 3, "equal_outcomes": 3, "identical": 3}


def test_episodes_depend_on_the_seed_but_not_on_threads(table: Path) -> None:
    def states(words: str) -> np.ndarray:
        return read_shard(create(table, words)[1])["frame/state"]

    one = states("--threads 1 --limit 2")
    assert np.array_equal(one, states("--threads 2 --limit 2"))
    assert not np.array_equal(one[0], states("--seed 1 --limit 2")[0])


def test_a_replay_that_differs_ends_with_1(table: Path) -> None:
    _, file = create(table)
    action = np.array(read_shard(file)["frame/action"])
    action[:, 7:] = action[0, 7:]  # the hand stays open
    assert graspd("episodes replay", rewrite(file, "open.h5", frame__action=action), code=1)["identical"] == 0


def test_grasps_out_of_reach_are_episodes_without_frames(table: Path) -> None:
    file = table.with_name("far.h5")
    told = graspd("episodes create --arm ur10e -o", file, "--base", "5 0 0 1 0 0 0", table)
    assert (told["executed"], told["outcomes"]) == (0, {"out of reach": 3})
    assert graspd("episodes replay", file)["episodes"] == 0
    assert [len(one.state) for one in episodes_of_shard(read_shard(file))] == [0, 0, 0]


def test_films_are_stored_by_camera_and_episode(table: Path) -> None:
    shard = read_shard(table, kind="base")
    hand, obj, placed = hand_of_shard(shard, None), object_of_shard(shard, None), scenes_of_shard(shard)

    def film(episode: Episode) -> Episode:
        at = {"wrist": np.full((len(episode.state), 7), float(episode.row))}
        return replace(episode, videos={"wrist_depth": bytes([episode.row]) * (episode.row + 1)}, camera_pose=at)

    columns, attributes = record_episodes(
        shard, hand, obj, placed, EpisodeOptions(), film=lambda robot, found: film, run=ExecutionContext(threads=2)
    )
    file = table.with_name("film.h5")
    file.write_bytes(write_shard("episodes", columns, attributes))
    for one in episodes_of_shard(read_shard(file)):
        assert one.videos == {"wrist_depth": bytes([one.row]) * (one.row + 1)}
        np.testing.assert_array_equal(one.camera_pose["wrist"], np.full((len(one.state), 7), one.row))


def test_other_assets_than_the_recorded_ones_are_refused(table: Path) -> None:
    _, file = create(table, "--arm franka --limit 1", "arm.h5")
    assert "changed since" in refused("episodes replay", rewrite(file, "other.h5", arm_digest="0" * 32))
    assert "digest" in refused("episodes replay --hand allegro", file)
    again = replay_episodes(read_shard(file), hand="barrett", obj="block")
    assert again[0].outcome.name == "SUCCEEDED"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--mount flange", "need an arm"),
        ("--arm ur10 ", "ur10e"),
        ("--arm franka --mount nowhere", "no link 'nowhere'"),
        ("--fps 1000", "60"),
    ],
)
def test_bad_options_end_with_one_line(table: Path, words: str, said: str) -> None:
    assert said in refused(f"episodes create {words}", table)


def test_grasps_without_a_scene_and_other_files_end_with_one_line(table: Path, tmp_path: Path) -> None:
    graspd(f"{PAIR} -n 1 -o", tmp_path / "free.h5")
    assert "--scene table" in refused("episodes create", tmp_path / "free.h5")
    assert "is needed here" in refused("episodes replay", table)


@pytest.mark.parametrize(
    ("aside", "turned", "outcome"), [(0.01, 10, "SUCCEEDED"), (0.03, 0, "TOUCHED"), (0, 20, "DROPPED")]
)
def test_a_neighbour_may_move_by_2_cm_and_the_object_turn_by_15_degrees(
    table: Path, aside: float, turned: float, outcome: str
) -> None:
    shard = read_shard(create(table, "--limit 1", "one.h5")[1])
    hand, obj, placed = hand_of_shard(shard, None), object_of_shard(shard, None), scenes_of_shard(shard)
    simulation, (episode,) = Simulation(Robot(hand), obj, decompose(obj), placed, fps=15), episodes_of_shard(shard)
    beside, thing = episode.neighbour_pose.copy(), episode.object_pose.copy()
    beside[-1, 0, 0] += aside
    turn = quat_from_axis_angle(np.array([0, 0, 1.0]), np.radians(turned))
    thing[-1, 3:] = quat_multiply(turn, thing[-1, 3:])
    assert simulation.outcome(replace(episode, neighbour_pose=beside, object_pose=thing)).name == outcome
