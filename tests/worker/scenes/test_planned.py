"""Grasps planned in a scene, alone and beside neighbours: never nearer to it than stated, by MuJoCo's own distances."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from graspd.service.model.domain import JobOptions
from graspd.service.model.errors import InputError
from graspd.service.model.fidelity import resolve_fidelity
from graspd.service.model.scene_spec import SceneSpec
from graspd.service.model.transforms import apply
from graspd.service.store.shards import read_shard
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.generation import validated_grasps
from graspd.worker.grasps import Posture
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.planners import synthesize
from graspd.worker.planners.port import PlanRequest
from graspd.worker.scenes import neighbours
from graspd.worker.scenes.clearance import MARGIN_M, approach
from graspd.worker.scenes.kinds import rest_poses, supports_of
from graspd.worker.scenes.placement import gaps_between, joined_pieces, neighbour_of, scenes_of
from graspd.worker.scenes.trajectory import plan_way
from graspd.worker.simulation.environment import STANDOFF_M, PlacedGrasps, Scenes
from tests.worker.commands_run import graspd, refused
from tests.worker.hands.grippers import gripper
from tests.worker.models import object_from_mesh
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


def least_room(hand, way, grasps, row: int, scene) -> float:
    """Least distance of a hand from the obstacles on its whole way, by MuJoCo, at a hundred postures [m]."""
    one, wide = grasps.take(slice(row, row + 1)), way.open[row : row + 1]
    coming = approach(Posture(way.approach[row, -1:], wide), Posture(way.approach[row, :1], wide), 40)
    closing = approach(one.grasp, one.pregrasp, 30)
    lifting = Posture(np.repeat(one.grasp.hand_pose, 30, axis=0), np.repeat(one.grasp.joint_positions, 30, axis=0))
    lifting.hand_pose[:, :3] += np.linspace(0, 0.1, 30)[:, None] * scene.up
    parts, table = (coming, closing, lifting), scene.obstacles[0]
    found = [mujoco_room(hand, part, table).min() for part in parts]
    found += [mujoco_distances(hand, part, solid).min() for part in parts for solid in scene.obstacles[1:]]
    return min(found)


@pytest.mark.parametrize("case", ["planned", "planned_beside"])
def test_the_whole_way_is_as_clear_as_it_says(case: str, request: pytest.FixtureRequest) -> None:
    hand, obj, placed, grasps = request.getfixturevalue(case)
    way = plan_way(hand, obj, grasps, placed)
    assert way.clear.any()
    for row in np.flatnonzero(way.clear)[:4]:
        # Postures between those that were looked at may be nearer by what a finger's arc deviates from its chord.
        assert least_room(hand, way, grasps, row, placed.scenes[placed.index[row]]) >= MARGIN_M - 5e-4
        assert np.linalg.norm(way.approach[row, 0, :3] - way.approach[row, -1, :3]) == pytest.approx(STANDOFF_M)


def test_a_grasp_does_not_depend_on_the_scenes_of_the_others(planned) -> None:
    hand, obj, placed, grasps = planned
    alone = PlacedGrasps(placed.supports, placed.object_pose, placed.index[:3])
    found = synthesize(hand, obj, PlanRequest(count=3, fidelity=QUICK, seed=4, placed=alone))
    assert np.array_equal(found.grasp.hand_pose, grasps.grasp.hand_pose[:3])


def test_synth_in_a_scene_counts_grasps_that_lift(tmp_path: Path) -> None:
    out = tmp_path / "g.h5"
    table = "synth --hand barrett --object block --scene table"
    said = graspd(f"{table} --scenes 2 -n 3 --budget 8 --fidelity draft -o", out)
    assert {"scene", "scenes", "clear_share", "lift_share", "lift_hard_share"} <= set(said)
    assert said["lift_share"] <= said["clear_share"]
    shard = read_shard(out, kind="base")
    assert np.array_equal(shard["quality/valid"], shard["quality/success"] == 1)
    assert (np.asarray(shard["quality/clearance_m"]) >= MARGIN_M).all()
    again = graspd("evaluate --protocol lift", out)
    assert (again["gsr"], again["clear_share"]) == (said["valid"] / said["grasps"], 1.0)


def test_what_is_of_free_objects_only_is_refused_in_scenes(tmp_path: Path) -> None:
    out, pair = tmp_path / "g.h5", "--hand barrett --object block -o"
    graspd(f"synth -n 1 --want candidates --validation none --fidelity draft {pair}", out)
    assert "synth --scene" in refused("evaluate --protocol lift", out)
    assert "free objects only" in refused(f"synth --scene table --method dfc {pair}", out)


TABLE = {"kind": "half_space"}
UPRIGHT = (1.0, 0, 0, 0)


def cube(side: float = 0.05, name: str = "cube"):
    return object_from_mesh(trimesh.creation.box((side, side, side)), name)


def file_scene(*places: tuple[float, float, float], target: tuple[float, float, float] = (0, 0, 0.025)) -> SceneSpec:
    beside = [{"object": "cube", "pose": (*place, *UPRIGHT)} for place in places]
    return SceneSpec(kind="file", supports=(TABLE,), target=(*target, *UPRIGHT), neighbours=beside)


def test_neighbours_stand_where_the_file_says() -> None:
    places = [(0.1, 0, 0.025), (0, -0.2, 0.025)]
    scenes, poses = scenes_of(file_scene(*places), cube(), [cube(), cube()], count=2, seed=0)
    np.testing.assert_allclose(poses["scene/neighbour_pose"][1, :, :3], places)
    placed = scenes.placed(np.zeros(1, int))
    np.testing.assert_allclose(placed.neighbours_of(0)[0, :3], [0.1, 0, 0])
    box = placed.scenes[0].obstacles[1]
    np.testing.assert_allclose(box.distance(np.array([0.05, 0.0, 0.0])), 0.025, atol=1e-9)


def test_dropped_neighbours_stand_apart_on_the_table() -> None:
    thing, others = cube(), [cube(0.04), cube(0.06)]
    spec = SceneSpec(kind="table", neighbours=({"object": "a"}, {"object": "b"}))
    scenes, poses = scenes_of(spec, thing, others, count=2, seed=3)
    together = np.concatenate([poses["scene/object_pose"][:, None], poses["scene/neighbour_pose"]], axis=1)
    gaps = gaps_between([neighbour_of(one) for one in (thing, *others)], together)
    assert all((gap > 0).all() for gap in gaps.values())
    for number, one in enumerate((thing, *others)):
        for pose in together[:, number]:
            assert apply(pose, one.hull_vertices)[:, 2].min() == pytest.approx(0.0, abs=1e-9)
    assert len(scenes.placed(np.zeros(1, int)).scenes[0].obstacles) == 3


@pytest.mark.parametrize(
    ("places", "words"),
    [
        ([(0.03, 0, 0.025)], "cube and cube overlap by 20.0 mm in scene 0"),
        ([(0.1, 0, 0.025), (0.12, 0, 0.025)], "overlap by 30.0 mm"),
        ([(0.1, 0, 0.0)], "is 25.0 mm deep in support 0"),
    ],
)
def test_things_that_stand_in_one_another_are_refused(places, words: str) -> None:
    with pytest.raises(InputError, match=words):
        scenes_of(file_scene(*places), cube(), [cube()] * len(places), count=1, seed=0)


def test_hulls_are_joined_where_that_fills_least() -> None:
    """Eight cubes in a row and one apart: the row becomes one piece."""
    corners = np.asarray(trimesh.creation.box((0.01, 0.01, 0.01)).vertices)
    row = [corners + np.array([0.01 * k, 0, 0]) for k in range(8)]
    pieces = joined_pieces([*row, corners + np.array([0.09, 0, 0.02])], most=2)
    assert sorted(round(float(np.ptp(piece[:, 0])), 3) for piece in pieces) == [0.01, 0.08]


@pytest.fixture(scope="module")
def planned_beside():
    hand = hand_from_path("barrett")
    thing = object_from_path("block", face_error_m=QUICK.face_error_m)
    post, wall = object_from_mesh(trimesh.creation.box((0.03, 0.03, 0.2)), "post"), cube(0.06, "low")
    beside = [
        {"object": "post", "pose": (0.085, 0, 0.1, *UPRIGHT)},
        {"object": "low", "pose": (-0.09, 0.03, 0.03, *UPRIGHT)},
    ]
    target = (0, 0, float(-thing.vertices[:, 2].min()), *UPRIGHT)
    spec = SceneSpec(kind="file", supports=(TABLE,), target=target, neighbours=beside)
    scenes, _ = scenes_of(spec, thing, [post, wall], count=1, seed=0)
    placed = scenes.placed(np.zeros(8, int))
    grasps = synthesize(hand, thing, PlanRequest(count=8, fidelity=QUICK, seed=4, placed=placed))
    return hand, thing, placed, grasps


def test_synth_with_neighbours_writes_them_lifts_judge_alike(tmp_path: Path) -> None:
    out = tmp_path / "g.h5"
    table = "--scene table --with mug --scenes 1 -n 4 --want candidates --fidelity draft"
    said = graspd(f"synth --hand barrett --object block {table} -o", out)
    shard = read_shard(out, kind="base")
    assert shard["scene/neighbour_pose"].shape == (1, 1, 7)
    assert shard.attributes["neighbours"] == ["mug"]
    assert json.loads(str(shard.attributes["scene"]))["neighbours"][0]["object"] == "mug"
    told = graspd("evaluate --protocol lift", out)
    assert told["clear_share"] == said["clear_share"]
    held = {one["row"] for one in told["verdicts"] if one["held"] and one["clear"]}
    assert held == set(np.flatnonzero(np.asarray(shard["quality/success"]) == 1).tolist())


@pytest.mark.parametrize(
    ("args", "words"),
    [
        ("--scene table" + 9 * " --with mug", "at most 8"),
        ("--with mug", "neighbours need a scene"),
        ("--scene bin" + 8 * " --with mug", "no room for 8 neighbours beside block"),
        ("--scene table --with no-such-thing", "no-such-thing"),
    ],
)
def test_what_cannot_stand_beside_an_object_is_told_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, args: str, words: str
) -> None:
    monkeypatch.setattr(neighbours, "_DRAWS", 2)
    said = refused(f"synth --hand barrett --object block {args} -o", tmp_path / "g.h5")
    assert words in said and "Traceback" not in said


def test_a_gripper_lifts_a_box_from_a_table() -> None:
    hand, box = gripper(), object_from_mesh(trimesh.creation.box((0.03, 0.04, 0.06)))
    spec = SceneSpec(kind="table")
    scenes = Scenes(supports_of(spec), rest_poses(spec, box, count=2, seed=1)["scene/object_pose"])
    wanted = JobOptions(scene="table", fidelity="draft", want="candidates", grasps=4, seed=2)
    found = validated_grasps(hand, box, wanted, count=4, scenes=scenes, run=ExecutionContext(threads=1))
    # A box between flat pads is the plainest of tasks: hardly a grasp may miss it.
    assert found.shares["lift_share"] >= 0.75
