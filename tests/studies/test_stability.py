"""The maps of failure say what physics says, and the guards that they name hold."""

from __future__ import annotations

import json
import math
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from typer.testing import CliRunner

from graspd.commands.studies import STUDIES, app
from graspd.service.model.domain import JobRequest
from graspd.service.model.errors import MeshError
from graspd.service.model.fidelity import FIDELITIES
from graspd.service.model.studies import MapCell, Stability, StabilityMap, from_json, graded
from graspd.service.store.records import latest
from graspd.service.store.store import open_store
from graspd.studies.stability import assets, descents, gradients, integrators, report, studies
from graspd.studies.stability.report import markdown, write
from graspd.worker.engines import backend
from graspd.worker.execution_context import DEFAULT_CONTEXT
from graspd.worker.generation import validated_grasps
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.planners.fast_graspd.pairs import Pair, pair_of
from graspd.worker.simulation.data import HandState
from graspd.worker.simulation.model import LossOptions


@pytest.fixture(scope="module")
def hand() -> HandModel:
    backend.start()
    return hand_from_path("barrett")


@pytest.fixture(scope="module")
def pair(hand: HandModel) -> Pair:
    return pair_of(hand, object_from_path("block"), FIDELITIES["draft"], "cpu")


@pytest.mark.parametrize("name", ["direct (default)", "Gauss-Seidel, one sweep", "Jacobi, averaged"])
def test_the_planners_own_step_lies_where_its_integrators_are_good(name: str) -> None:
    way = LossOptions().step  # time step x speed [m]
    energy, sunk = integrators.position_based(integrators.SOLVERS[name], dt=1e-3, speed=way / 1e-3)
    assert graded(energy, *integrators.ENERGY) == "good"
    assert graded(sunk, *integrators.SINK_M) == "good"


@pytest.mark.parametrize(("share", "holds"), [(0.3, True), (2.5, False)])
def test_a_penalty_force_blows_up_above_the_bound_of_theory(share: float, holds: bool) -> None:
    stiffness, mass = 1e5, 1.0
    bound = 2 * math.sqrt(mass / stiffness)  # of semi-implicit Euler on one spring
    energy, _ = integrators.force_based(dt=share * bound, speed=0.05, stiffness=stiffness, mass=mass)
    assert (energy < integrators.ENERGY[1]) is holds


def test_summed_jacobi_overshoots_with_the_number_of_contacts() -> None:
    found = integrators.contact_count_map(counts=(1, 64))
    outcome = {(cell.panel, cell.x): cell.outcome for cell in found.cells if cell.y == 0.0}
    assert outcome["Jacobi, summed", 1] == "good"
    assert outcome["Jacobi, summed", 64] == "broken"
    assert outcome["Jacobi, averaged", 64] == outcome["direct (default)", 64] == "good"


def test_gradients_agree_at_the_sizes_of_hands_and_their_objects() -> None:
    found = gradients.gradient_map(sizes=(0.01, 0.04), gaps=(0.1, 0.3), repeats=3)
    assert [cell for cell in found.cells if cell.outcome == "broken"] == []


def test_a_shape_is_refused_or_its_grasps_are_sound(hand: HandModel) -> None:
    found = assets.shape_map(
        hand, fidelities=("draft",), count=4, families=(), defects=("a side is missing", "inside out")
    )
    by_name = {cell.x: cell for cell in found.cells}
    assert by_name["a side is missing"].outcome == "refused"
    assert by_name["inside out"].outcome in ("good", "weak"), by_name["inside out"].note


def test_a_mesh_without_an_inside_is_refused_with_the_mend() -> None:
    mesh, options = assets.DEFECTS["a side is missing"]
    with pytest.raises(MeshError, match="allow-open"):
        assets.prepared(mesh(), options, 1e-3)


def test_a_start_that_is_too_far_is_flagged(pair: Pair) -> None:
    state = descents.starts_of(pair, 2)
    far = HandState(state.pivot + np.array([0.0, 0.0, 0.6]), state.rotation, state.q)
    (cell,) = descents._cells(pair, descents.descend(pair, far, FIDELITIES["draft"]), "x", 0, 0)
    assert cell.outcome == "broken"


def test_a_job_whose_every_grasp_is_bad_ends_with_none(hand: HandModel) -> None:
    crumb = assets.prepared(assets.cube(1), {"units": "m"}, 1e-5)
    request = JobRequest(hand="hand", object="crumb", grasps=2, fidelity="draft", budget=2, rechecks=0)
    found = validated_grasps(hand, crumb, request, count=2)
    assert found.tried == len(found.grasps) + sum(found.rejected.values())
    assert (found.columns["quality/valid"] == 1).all()


def test_a_long_run_does_not_drift(pair: Pair) -> None:
    state = descents.starts_of(pair, 2)
    drift = descents.descend(pair, state, FIDELITIES["draft"], iterations=1500).drift
    # float32: a normalised quaternion is off by a few units in the last place, 6e-8, and never by nothing at all.
    assert 0 < drift < 1e-6


@pytest.mark.slow
def test_a_quick_run_takes_less_than_the_minute_that_it_promises() -> None:
    started = time.process_time()
    found = studies.run(
        STUDIES, "allegro", "block", quick=True, long=False, work=DEFAULT_CONTEXT, say=lambda line: None
    )
    assert time.process_time() - started < 60  # CPU seconds: others may keep the machine busy
    assert [one.name for one in found] == list(STUDIES) and all(one.cells for one in found)


def test_what_is_no_number_is_broken() -> None:
    assert [graded(value, 1.0, 2.0) for value in (0.5, 1.5, 2.5, math.nan, math.inf)] == [
        "good",
        "weak",
        "broken",
        "broken",
        "broken",
    ]


def a_map(**changes: object) -> StabilityMap:
    cells = [
        MapCell("a", 1.0, 10.0, 0.1, "good", reached=True),
        MapCell("a", 2.0, 10.0, math.inf, "broken", "why", "", True),
    ]
    cells.append(MapCell("a", 3.0, 10.0, 5.0, "broken"))
    one = StabilityMap("demo", "A demo", "x", "y", "m", "weak: 1", cells, "it flies", "g", "t", {"a": [(1.0, 10.0)]})
    return replace(one, **changes)


def a_record(*maps: StabilityMap) -> Stability:
    return Stability("2026-11-21T12:00:00.000Z", "graspd stability", {"graspd": "0"}, list(maps or [a_map()]))


def test_a_report_has_a_picture_and_a_table_for_each_map(tmp_path: Path) -> None:
    written = write(a_record(), tmp_path)
    assert {path.name for path in written} == {"stability.json", "stability.md", "stability-demo.png"}
    assert json.loads(written[0].read_text())["maps"][0]["cells"][1]["value"] is None
    assert "| a | 1 | 0 | 2 | 0 |" in markdown(a_record())
    assert written[2].read_bytes().startswith(b"\x89PNG")


def test_a_report_says_what_still_breaks_and_how_a_user_sees_it() -> None:
    said = markdown(a_record())
    assert "| A demo | 1 | 0 | 1 | 0 | a 2 (10) | it flies |" in said
    whole = [replace(cell, outcome="good") for cell in a_map().cells]
    assert "| A demo | 2 | 0 | 0 | 0 | nothing | – |" in markdown(a_record(a_map(cells=whole)))


@pytest.mark.parametrize("letters", ["9", "0.12", "123456789012345678901234567890"])
def test_numbers_on_a_picture_stay_within_their_cells(letters: str) -> None:
    figure = Figure(figsize=(4.4, 3.4))
    axes = figure.subplots()
    cells = [MapCell("a", float(x), float(y), 1.0, "good", label=letters) for x in range(1, 10) for y in (1, 2)]
    report._panel(axes, a_map(cells=cells, lines={}), "a")
    report._fit(axes)
    width = axes.get_window_extent().width / 9
    assert all(not text.get_visible() or text.get_window_extent().width < width for text in axes.texts)
    assert axes.texts[0].get_visible() is (len(letters) < 20)


def command(*arguments: str) -> tuple[int, str]:
    done = CliRunner().invoke(app, ["stability", *arguments])
    return done.exit_code, done.output


def test_without_a_choice_all_studies_are_made(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    monkeypatch.setattr(studies, "run", lambda names, *_, **__: asked.extend(names) or [])
    assert command("--json")[0] == 0
    assert asked == list(STUDIES)
    assert len(asked) == 15


def test_published_maps_are_the_latest_in_the_store(tmp_path: Path) -> None:
    write(a_record(), tmp_path)
    code, said = command("--from", str(tmp_path / "stability.json"), "--publish", "--data-dir", str(tmp_path))
    assert code == 0, said
    stored = latest(open_store((tmp_path / "store").as_uri()), "stability")
    assert stored is not None
    assert from_json(stored).as_json() == a_record().as_json()


@pytest.mark.parametrize("text", ["no json", "{}", '{"maps": 3}'])
def test_a_file_that_holds_no_maps_is_the_callers_mistake(tmp_path: Path, text: str) -> None:
    (tmp_path / "wrong.json").write_text(text)
    code, said = command("--from", str(tmp_path / "wrong.json"))
    assert code == 2
    assert "no stability.json" in said


@pytest.mark.parametrize("arguments", [["--only", "magic"], ["--from", "nowhere.json"]])
def test_a_wrong_option_is_the_callers_mistake(arguments: list[str]) -> None:
    assert command(*arguments)[0] == 2
