"""Scenes that are hard: each ends in a clear line, in fewer grasps that are said, or in grasps that are clear."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from graspd.cli import build
from graspd.commands.studies import app
from graspd.service.model.errors import InputError
from graspd.service.model.scene_spec import SceneSpec
from graspd.service.model.studies import MapCell, Stability, StabilityMap, from_json
from graspd.studies.stability import scenes
from graspd.worker.engines import backend
from graspd.worker.generation import ValidatedBatch
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.scenes.kinds import supports_of
from graspd.worker.scenes.trajectory import MARGIN_M
from tests.worker.simulation.test_surroundings import mujoco_room


@pytest.fixture(scope="module")
def hand() -> HandModel:
    backend.start()
    return hand_from_path("barrett")


def assert_valid_ones_are_clear(hand: HandModel, found: ValidatedBatch, spec: SceneSpec) -> None:
    """By MuJoCo's distances at the grasp, whatever the planner thinks of its clearance."""
    rows = np.flatnonzero(found.columns["quality/valid"] == 1)
    assert (found.columns["quality/clearance_m"][rows] >= MARGIN_M).all()
    assert spec.target is not None
    for support in supports_of(spec) if len(rows) else ():
        seen = support.seen_from(np.asarray(spec.target, float))
        assert mujoco_room(hand, found.grasps.grasp.take(rows), seen).min() >= MARGIN_M - 1e-6


def test_a_plate_flat_on_a_table_ends_with_fewer_and_says_so(tmp_path: Path) -> None:
    plate = tmp_path / "plate.stl"
    trimesh.creation.box((0.15, 0.15, 0.003)).export(plate)
    words = [
        "synth",
        "--hand",
        "barrett",
        "--object",
        str(plate),
        "--units",
        "m",
        "--scene",
        "table",
        "--faces",
        "all",
        "--scenes",
        "1",
        "-n",
        "2",
        "--budget",
        "2",
        "--fidelity",
        "draft",
        "-o",
        str(tmp_path / "g.h5"),
    ]
    result = CliRunner().invoke(build(), words)
    assert result.exit_code == 3, result.output
    assert "the budget of 2 candidates for each ended first" in result.output
    assert "of the candidates are clear of what stands there" in result.output


@pytest.mark.parametrize("gap", [5, 30])
def test_an_object_in_a_narrow_well_is_refused_or_comes_out_valid(hand: HandModel, gap: float) -> None:
    sides, spec = scenes._standing(scenes.TARGET_MM, scenes._walls(scenes.WALLS["four"], gap))
    try:
        found = scenes.planned(hand, sides, spec, "draft", 2)
    except InputError as error:
        assert "\n" not in str(error) and ("no room" in str(error) or "on every side" in str(error))
    else:
        assert_valid_ones_are_clear(hand, found, spec)


def test_one_wall_nearby_costs_grasps_but_is_no_reason_to_refuse(hand: HandModel) -> None:
    sides, spec = scenes._standing(scenes.TARGET_MM, scenes._walls(scenes.WALLS["one"], 20))
    found = scenes.planned(hand, sides, spec, "draft", 6)
    assert found.shares["clear_share"] > 0.5
    assert_valid_ones_are_clear(hand, found, spec)


def test_a_box_among_boxes_is_lifted_out_or_not_valid(hand: HandModel) -> None:
    sides, spec = scenes._standing(scenes.TARGET_MM, scenes._neighbours(scenes.NEIGHBOURS["four"], 120))
    found = scenes.planned(hand, sides, spec, "draft", 6)
    assert found.shares["lift_share"] > 0, "with so much room some must come out"
    assert_valid_ones_are_clear(hand, found, spec)


def test_a_cube_that_does_not_fit_its_bin_is_refused(hand: HandModel) -> None:
    with pytest.raises(InputError, match="there is room for 380 x 280 mm"):
        scenes.planned(hand, (350, 350, 350), SceneSpec(kind="bin"), "draft", 2)


def test_walls_and_neighbours_stand_off_by_their_gap() -> None:
    half = np.array(scenes.TARGET_MM[:2]) * scenes.MILLIMETRES / 2
    for boxes in (scenes._walls(scenes.WALLS["four"], 20), scenes._neighbours(scenes.NEIGHBOURS["eight"], 20)):
        for box in boxes:
            away = np.abs(box.pose[:2]) - np.array(box.size[:2]) / 2 - half
            assert away.max() == pytest.approx(0.02)


def test_a_refused_scene_is_a_cell_that_says_why(hand: HandModel) -> None:
    found = scenes.wall_map([hand], gaps=(-5,), walls=("one",), count=2)
    (cell,) = found.cells
    assert cell.outcome == "refused" and "deep in support" in cell.note


def test_a_hand_spans_what_it_takes_around(hand: HandModel) -> None:
    # From a BarrettHand's data sheet: 335 mm at most, fingers stretched; the preshape is about two thirds open.
    assert 0.1 < scenes.span_of(hand) < 0.335


def test_maps_of_several_runs_are_drawn_and_published_as_one(tmp_path: Path) -> None:
    cells = [MapCell("one", 1.0, "a", 0.5, "good")]
    for name, value in (("first", 1.0), ("second", 2.0)):
        one = StabilityMap("shared", name, "x", "y", "m", "b", cells, "s", "g")
        own = StabilityMap(name, name, "x", "y", "m", "b", cells, "s", "g")
        run = Stability(f"2026-01-0{value:.0f}T00:00:00Z", f"graspd stability {name}", {"graspd": "0"}, [one, own])
        (tmp_path / f"{name}.json").write_text(json.dumps(run.as_json()))
    words = [part for name in ("first", "second") for part in ("--from", str(tmp_path / f"{name}.json"))]
    result = CliRunner().invoke(app, ["stability", *words, "--out", str(tmp_path / "out"), "--json"])
    assert result.exit_code == 0, result.output
    found = from_json(json.loads((tmp_path / "out" / "stability.json").read_text()))
    assert {one.name: one.title for one in found.maps} == {"shared": "second", "first": "first", "second": "second"}
    assert found.command == "graspd stability first; graspd stability second"
