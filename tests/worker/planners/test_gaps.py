"""The geometric reason why nothing can be grasped in a scene: gaps, widths and heights that a hand is too large for."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from graspd.commands.synth import _said
from graspd.service.model.domain import JobOptions
from graspd.service.model.fidelity import FIDELITIES
from graspd.service.model.scene_spec import SceneSpec
from graspd.service.model.transforms import IDENTITY_POSE
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.files.synthesis import synthesized
from graspd.worker.generation import validated_grasps
from graspd.worker.hands.jaws import thinnest_fingertip
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.pinch_postures import oppositions_of
from graspd.worker.planners.fast_graspd.antipodal_starts import Openings, crossings_of, room_beside, why_narrow
from graspd.worker.simulation.environment import Environment, Obstacle, Scenes
from tests.worker.models import object_from_mesh

UP = np.array([0.0, 0, 1])
SIZE = np.array([0.05, 0.06, 0.08])
BOX = object_from_mesh(trimesh.creation.box(SIZE))
UPRIGHT = (1.0, 0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def barrett():
    return hand_from_path("barrett")


def beside_walls(gap: float, axes: tuple[int, ...]) -> Environment:
    """The box on a table, with a wall as high as itself beside it along +x, +y or both [m]."""
    found = [Obstacle.half_space(UP, -0.5 * SIZE[2])]
    for axis in axes:
        centre, size = np.zeros(3), np.full(3, 0.4)
        centre[axis], size[axis] = 0.5 * SIZE[axis] + gap + 0.01, 0.02
        found.append(Obstacle.box((*centre, *UPRIGHT), size))
    return Environment(tuple(found), UP)


def test_a_gap_is_named_with_the_fingertip_that_does_not_fit(barrett) -> None:
    told = why_narrow(barrett, BOX, [beside_walls(0.008, (0, 1))])
    assert told is not None
    assert "about 8 mm" in told
    assert f"{1e3 * thinnest_fingertip(barrett):.0f} mm" in told
    # One of several scenes that has room is enough, and so is one axis that is free.
    assert why_narrow(barrett, BOX, [beside_walls(0.008, (0, 1)), beside_walls(0.03, (0, 1))]) is None
    assert why_narrow(barrett, BOX, [beside_walls(0.008, (0,))]) is None
    assert why_narrow(barrett, BOX, [beside_walls(0.008, ())]) is None


def test_what_is_too_wide_or_too_low_is_told(barrett) -> None:
    large = object_from_mesh(trimesh.creation.box([0.4, 0.4, 0.4]))
    table = Environment((Obstacle.half_space(UP, -0.2),), UP)
    assert f"opens to {1e3 * oppositions_of(barrett).widest:.0f} mm" in str(why_narrow(barrett, large, [table]))
    sheet = object_from_mesh(trimesh.creation.box([0.08, 0.08, 0.004]))
    table = Environment((Obstacle.half_space(UP, -0.002),), UP)
    assert "lies 4 mm high" in str(why_narrow(hand_from_path("allegro"), sheet, [table]))


def test_a_ball_beside_a_pair_keeps_its_distance_from_a_wall() -> None:
    pairs, gap, width = crossings_of(BOX), 0.03, 0.02
    right = pairs.ends()[1][:, 0] > 0.5 * SIZE[0] - 1e-6
    across = right & (pairs.axis[:, 0] > 0.999)
    assert across.any()
    room = room_beside(pairs, beside_walls(gap, (0,)), width)
    assert room[across] == pytest.approx(gap - width, abs=1e-4)
    assert np.isinf(room_beside(pairs, beside_walls(gap, ()), width)).all()


def test_pairs_with_room_for_fingertips_are_drawn_more_often(barrett) -> None:
    scene, known = beside_walls(0.008, (0,)), oppositions_of(barrett)

    def share(tip: float) -> float:
        opening = Openings.of(known, BOX, scene, tip=tip)
        chance = np.diff(opening.sums, prepend=0.0)
        return float(chance[np.abs(opening.pairs.axis[:, 1]) > 0.9].sum())

    assert share(thinnest_fingertip(barrett)) > 0.85 > share(0.0)


def test_a_batch_without_a_valid_grasp_says_the_reason(barrett) -> None:
    walls = beside_walls(0.008, (0, 1)).obstacles
    scenes = Scenes(walls, np.array([IDENTITY_POSE]))
    request = JobOptions(grasps=1, budget=1.0, rechecks=0, scene="table", fidelity=FIDELITIES["draft"])
    found = validated_grasps(barrett, BOX, request, count=1, scenes=scenes, run=ExecutionContext(threads=1))
    assert not len(found.grasps)
    assert found.narrow == why_narrow(barrett, BOX, scenes.placed(np.zeros(1, int)).scenes)
    assert "8 mm" in str(found.narrow)


def test_candidate_grasps_none_of_which_is_valid_come_with_the_reason(tmp_path) -> None:
    sheet = tmp_path / "sheet.stl"
    trimesh.creation.box([0.08, 0.08, 0.004]).export(sheet)
    place, request = SceneSpec(kind="table"), JobOptions(want="candidates", grasps=1, fidelity="draft", scene="table")
    made = synthesized("allegro", str(sheet), request, place=place, scenes=1)
    found = made.summary()
    assert (found["grasps"], found["valid"], found["reason"]) == (1, 0, None)
    assert "lies 4 mm high" in found["narrow"]
    assert _said({"file": "g.h5", **found}).endswith(found["narrow"])
