"""Grasps planned in a scene: never nearer to it than stated, by MuJoCo's own distances, at a hundred postures."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from graspd.cli import build
from graspd.service.model.fidelity import resolve_fidelity
from graspd.service.model.scene_spec import SceneSpec
from graspd.service.store.shards import read_shard
from graspd.worker.grasps import Posture
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.planners import synthesize
from graspd.worker.planners.port import PlanRequest
from graspd.worker.scenes.clearance import MARGIN_M, approach
from graspd.worker.scenes.kinds import rest_poses, supports_of
from graspd.worker.scenes.trajectory import plan_way
from graspd.worker.simulation.environment import STANDOFF_M, Obstacle, PlacedGrasps
from tests.worker.simulation.test_surroundings import mujoco_distances, mujoco_room, parted

#: What a draft's finish may lack of a distance that it aims at exactly [m].
DRAFT_M = 5e-4
QUICK = resolve_fidelity("draft").model_copy(update={"starts": 2})


@pytest.fixture(scope="module")
def planned():
    hand = hand_from_path("barrett")
    obj = object_from_path("block", face_error_m=QUICK.face_error_m)
    spec = SceneSpec(kind="table")
    placed = PlacedGrasps(
        supports_of(spec), rest_poses(spec, obj, count=2, seed=1)["scene/object_pose"], np.arange(8) % 2
    )
    return hand, obj, placed, synthesize(hand, obj, PlanRequest(count=8, fidelity=QUICK, seed=4, placed=placed))


def test_every_grasp_is_clear_of_the_table_by_mujocos_distances(planned) -> None:
    hand, _, placed, grasps = planned
    tips, rest = parted(hand)
    for number, scene in enumerate(placed.scenes):
        rows = np.flatnonzero(placed.index == number)
        mine = grasps.grasp.take(rows)
        assert mujoco_distances(rest, mine, scene.obstacles[0]).min() >= MARGIN_M
        # They may touch the table. A draft's few steps of finish leave less than this to fix; then none is clear.
        assert mujoco_distances(tips, mine, scene.obstacles[0]).min() >= -DRAFT_M


def test_fingertips_keep_what_the_scene_says_and_no_less() -> None:
    hand, obj = hand_from_path("barrett"), object_from_path("block", face_error_m=QUICK.face_error_m)
    supports = tuple(replace(one, tips_m=-0.001) for one in supports_of(SceneSpec(kind="table")))
    # A thin slice of the block sticks out of the table: what holds it must reach down to there.
    sunk = np.array([[0, 0, float(-obj.vertices[:, 2].max()) + 0.012, 1, 0, 0, 0]])
    placed = PlacedGrasps(supports, sunk, np.zeros(12, int))
    found = synthesize(hand, obj, PlanRequest(count=12, fidelity=QUICK, seed=4, placed=placed)).grasp
    tips, rest = parted(hand)
    table = placed.scenes[0].obstacles[0]
    lowest = mujoco_distances(tips, found, table)
    assert lowest.min() >= -0.001 - DRAFT_M
    assert lowest.min() < 0.001, "no fingertip came down to the table"
    assert mujoco_distances(rest, found, table).min() >= MARGIN_M


def test_the_whole_way_is_as_clear_as_it_says(planned) -> None:
    hand, obj, placed, grasps = planned
    way = plan_way(hand, obj, grasps, placed)
    assert way.clear.any()
    for row in np.flatnonzero(way.clear):
        scene = placed.scenes[placed.index[row]]
        coming = approach(
            Posture(way.approach[row, -1:], way.open[row : row + 1]),
            Posture(way.approach[row, :1], way.open[row : row + 1]),
            40,
        )
        one = grasps.take(slice(row, row + 1))
        closing = approach(one.grasp, one.pregrasp, 30)
        lifting = Posture(np.repeat(one.grasp.hand_pose, 30, axis=0), np.repeat(one.grasp.joint_positions, 30, axis=0))
        lifting.hand_pose[:, :3] += np.linspace(0, 0.1, 30)[:, None] * scene.up
        least = min(mujoco_room(hand, part, scene.obstacles[0]).min() for part in (coming, closing, lifting))
        # Postures between those that were looked at may be nearer by what a finger's arc deviates from its chord.
        assert least >= MARGIN_M - 5e-4
        assert np.linalg.norm(way.approach[row, 0, :3] - way.approach[row, -1, :3]) == pytest.approx(STANDOFF_M)


def test_a_grasp_does_not_depend_on_the_scenes_of_the_others(planned) -> None:
    hand, obj, placed, grasps = planned
    alone = PlacedGrasps(placed.supports, placed.object_pose, placed.index[:3])
    found = synthesize(hand, obj, PlanRequest(count=3, fidelity=QUICK, seed=4, placed=alone))
    assert np.array_equal(found.grasp.hand_pose, grasps.grasp.hand_pose[:3])


def test_a_scene_without_obstacles_leaves_the_hand_free_to_come_from_below() -> None:
    hand, obj = hand_from_path("barrett"), object_from_path("block", face_error_m=QUICK.face_error_m)
    nothing = PlacedGrasps((), np.array([[0, 0, 0, 1.0, 0, 0, 0]]), np.zeros(8, int))
    found = synthesize(hand, obj, PlanRequest(count=8, fidelity=QUICK, seed=4, placed=nothing))
    below = Obstacle.half_space([0, 0, 1], -0.03)
    assert (mujoco_distances(hand, found.grasp, below) < 0).any()


def test_synth_in_a_scene_counts_grasps_that_lift(tmp_path: Path) -> None:
    out = tmp_path / "g.h5"
    result = CliRunner().invoke(
        build(),
        [
            "synth",
            "--hand",
            "barrett",
            "--object",
            "block",
            "--scene",
            "table",
            "--scenes",
            "2",
            "-n",
            "3",
            "--budget",
            "8",
            "--fidelity",
            "draft",
            "-o",
            str(out),
            "--json",
        ],
    )
    assert result.exit_code == 0, result.output
    said = json.loads(result.stdout.splitlines()[-1])
    assert {"scene", "scenes", "clear_share", "lift_share", "lift_hard_share"} <= set(said)
    assert said["lift_share"] <= said["clear_share"]
    shard = read_shard(out, kind="base")
    assert np.array_equal(shard["quality/valid"], shard["quality/success"] == 1)
    assert (np.asarray(shard["quality/clearance_m"]) >= MARGIN_M).all()
    validated = CliRunner().invoke(build(), ["evaluate", str(out), "--protocol", "lift", "--json"])
    again = json.loads(validated.stdout.splitlines()[-1])
    assert again["gsr"] == said["valid"] / said["grasps"]
    assert again["clear_share"] == 1.0


def test_lifting_grasps_of_a_free_object_is_refused(tmp_path: Path) -> None:
    out = tmp_path / "g.h5"
    args = ["--hand", "barrett", "--object", "block", "-n", "1", "--want", "candidates", "--validation", "none"]
    CliRunner().invoke(build(), ["synth", *args, "--fidelity", "draft", "-o", str(out)])
    result = CliRunner().invoke(build(), ["evaluate", str(out), "--protocol", "lift"])
    assert result.exit_code == 2
    assert "synth --scene" in result.output


def test_a_method_for_free_objects_says_so(tmp_path: Path) -> None:
    result = CliRunner().invoke(
        build(),
        [
            "synth",
            "--hand",
            "barrett",
            "--object",
            "block",
            "--scene",
            "table",
            "--method",
            "dfc",
            "-o",
            str(tmp_path / "g.h5"),
        ],
    )
    assert result.exit_code == 2
    assert "free objects only" in result.output
