"""Neighbours in the scene that grasps are planned in: where they stand, what is refused, and that hands stay clear."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from graspd.cli import build
from graspd.service.model.errors import InputError
from graspd.service.model.fidelity import resolve_fidelity
from graspd.service.model.scene_spec import SceneSpec
from graspd.service.store.shards import read_shard
from graspd.worker.grasps import Posture
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.planners import synthesize
from graspd.worker.planners.port import PlanRequest
from graspd.worker.scenes.clearance import MARGIN_M, approach
from graspd.worker.scenes.placement import gaps_between, joined_pieces, neighbour_of, scenes_of
from graspd.worker.scenes.trajectory import plan_way
from tests.worker.models import object_from_mesh
from tests.worker.simulation.test_solids import geom_distances
from tests.worker.simulation.test_surroundings import mujoco_room

QUICK = resolve_fidelity("draft").model_copy(update={"starts": 2})
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
    assert len(scenes.placed(np.zeros(1, int)).scenes[0].obstacles) == 3


@pytest.mark.parametrize(
    ("places", "words"),
    [
        ([(0.03, 0, 0.025)], "cube and cube overlap by 20.0 mm in scene 0"),
        ([(0.1, 0, 0.025), (0.12, 0, 0.025)], "overlap by 30.0 mm"),
        ([(0.1, 0, 0.0)], "stands 25.0 mm deep in support 0"),
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
def planned():
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


def test_the_whole_way_between_neighbours_is_as_clear_as_it_says_by_mujocos_distances(planned) -> None:
    """At a hundred postures; those between the ones that were looked at may be nearer by what a finger's arc deviates
    from its chord."""
    hand, thing, placed, grasps = planned
    way = plan_way(hand, thing, grasps, placed)
    assert way.clear.any()
    scene = placed.scenes[0]
    for row in np.flatnonzero(way.clear)[:4]:
        one = grasps.take(slice(row, row + 1))
        wide = way.open[row : row + 1]
        coming = approach(Posture(way.approach[row, -1:], wide), Posture(way.approach[row, :1], wide), 40)
        closing = approach(one.grasp, one.pregrasp, 30)
        lifting = Posture(np.repeat(one.grasp.hand_pose, 30, axis=0), np.repeat(one.grasp.joint_positions, 30, axis=0))
        lifting.hand_pose[:, :3] += np.linspace(0, 0.1, 30)[:, None] * scene.up
        for part in (coming, closing, lifting):
            found = [mujoco_room(hand, part, scene.obstacles[0])]
            found += [geom_distances(hand, part, solid) for solid in scene.obstacles[1:]]
            assert np.min(found) >= MARGIN_M - 5e-4


def test_without_its_neighbours_the_same_hand_would_reach_through_them(planned) -> None:
    """The test above would pass for a scene in which nothing is in the way."""
    hand, thing, placed, _ = planned
    alone = type(placed)(placed.supports, placed.object_pose, placed.index)
    grasps = synthesize(hand, thing, PlanRequest(count=8, fidelity=QUICK, seed=4, placed=alone))
    least = [geom_distances(hand, grasps.grasp, solid) for solid in placed.scenes[0].obstacles[1:]]
    assert np.min(least) < 0


def test_synth_with_neighbours_writes_them_and_its_lifts_are_validated_again_alike(tmp_path: Path) -> None:
    out = tmp_path / "g.h5"
    args = ["synth", "--hand", "barrett", "--object", "block", "--scene", "table", "--with", "mug", "--scenes", "1"]
    result = CliRunner().invoke(
        build(), [*args, "-n", "4", "--want", "candidates", "--fidelity", "draft", "-o", str(out), "--json"]
    )
    assert result.exit_code == 0, result.output
    said = json.loads(result.stdout.splitlines()[-1])
    shard = read_shard(out, kind="base")
    assert shard["scene/neighbour_pose"].shape == (1, 1, 7)
    assert shard.attributes["neighbours"] == ["mug"]
    assert json.loads(str(shard.attributes["scene"]))["neighbours"][0]["object"] == "mug"
    again = CliRunner().invoke(build(), ["evaluate", str(out), "--protocol", "lift", "--json"])
    told = json.loads(again.stdout.splitlines()[-1])
    assert told["clear_share"] == said["clear_share"]
    held = {one["row"] for one in told["verdicts"] if one["held"] and one["clear"]}
    assert held == set(np.flatnonzero(np.asarray(shard["quality/success"]) == 1).tolist())


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["--scene", "table", *["--with", "mug"] * 9], "at most 8"),
        (["--with", "mug"], "neighbours stand in a scene"),
        (["--scene", "bin", *["--with", "mug"] * 8], "no room for 8 neighbours beside block"),
        (["--scene", "table", "--with", "no-such-thing"], "no-such-thing"),
    ],
)
def test_what_cannot_stand_beside_an_object_is_told_in_one_line(tmp_path: Path, args: list[str], words: str) -> None:
    base = ["synth", "--hand", "barrett", "--object", "block", "-o", str(tmp_path / "g.h5")]
    result = CliRunner().invoke(build(), [*base, *args])
    assert result.exit_code == 2
    assert words in " ".join(result.output.split())
    assert "Traceback" not in result.output
