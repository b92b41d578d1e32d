"""The maps of failure say what physics says of integrators, hands, models and scenes, and the guards they name hold."""

import json
import math
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from benchmarks.integrators import descents, flights, gradients, hands, scenes
from benchmarks.integrators.__main__ import MAPS, measure
from benchmarks.integrators.grades import grade
from benchmarks.integrators.hands import Coupling, ring_hand
from benchmarks.integrators.model_errors import ERRORS, model_error_map
from graspd.commands.studies import STUDIES
from graspd.commands.synth import _format_summary
from graspd.service.model.domain import JobRequest
from graspd.service.model.errors import InputError
from graspd.service.model.fidelity import FIDELITIES
from graspd.service.model.metrics import PerturbedParameter
from graspd.service.model.scene_spec import SceneSpec
from graspd.service.model.studies import MapCell, Stability, StabilityMap, parse_stability
from graspd.service.store.records import latest_record
from graspd.service.store.store import open_store
from graspd.studies.stability import shapes
from graspd.studies.stability.report import markdown, write
from graspd.studies.stability.shapes import MapOptions
from graspd.worker.engines import backend
from graspd.worker.execution_context import DEFAULT_CONTEXT
from graspd.worker.generation import ValidatedBatch, validated_grasps
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.planners.fast_graspd.pairs import Pair, pair_of
from graspd.worker.scenes.kinds import supports_of
from graspd.worker.scenes.trajectory import MARGIN_M
from graspd.worker.simulation.data import HandState
from graspd.worker.simulation.model import LossOptions
from graspd.worker.validation.variant import Variant, draw_variant
from tests.worker.commands_run import graspd, refused
from tests.worker.simulation.test_surroundings import mujoco_room

FEW = MapOptions(4)
FRICTION, MASS = "friction, relative to the model", "mass, relative to the model"
#: What of a variant stands for an error's amount.
AMOUNTS = {
    "collision shapes of the hand grown by [mm]": (PerturbedParameter.SHAPES, lambda v: 1e3 * v.grown_m),
    FRICTION: (PerturbedParameter.FRICTION, lambda v: v.friction),
    MASS: (PerturbedParameter.MASS, lambda v: v.mass),
    "gains, relative to the model": (PerturbedParameter.JOINTS, lambda v: v.gain),
    "armature [1e-4 kg m²]": (PerturbedParameter.JOINTS, lambda v: 1e4 * (v.armature or 0.0)),
    "dry friction of joints [N m]": (PerturbedParameter.JOINTS, lambda v: v.dry_friction or 0.0),
    "object displaced by [mm]": (PerturbedParameter.POSE, lambda v: 1e3 * np.linalg.norm(v.object_shift_m)),
    "object rotated by [°]": (PerturbedParameter.POSE, lambda v: np.degrees(np.linalg.norm(v.object_turn))),
    "hand displaced by [mm]": (PerturbedParameter.CALIBRATION, lambda v: 1e3 * np.linalg.norm(v.hand_shift_m)),
    "centre of mass displaced by [mm]": (PerturbedParameter.CENTRE, lambda v: 1e3 * np.linalg.norm(v.centre_m)),
    "last finger delayed by [share of closing]": (PerturbedParameter.ORDER, lambda v: max(v.lags)),
}


@pytest.fixture(scope="module")
def hand() -> HandModel:
    backend.start_warp()
    return hand_from_path("barrett")


@pytest.fixture(scope="module")
def pair(hand: HandModel) -> Pair:
    return pair_of(hand, object_from_path("block"), FIDELITIES["draft"], "cpu")


@pytest.mark.parametrize("name", ["direct (default)", "Gauss-Seidel, one sweep", "Jacobi, averaged"])
def test_planners_own_step_lies_where_its_integrators_are_good(name: str) -> None:
    way = LossOptions().step  # time step x speed [m]
    energy, sunk = flights.simulate_position_based(flights.SOLVERS[name], dt=1e-3, speed=way / 1e-3)
    assert grade(energy, *flights.ENERGY) == grade(sunk, *flights.SINK_M) == "good"


@pytest.mark.parametrize(("share", "holds"), [(0.3, True), (2.5, False)])
def test_a_penalty_force_blows_up_above_the_bound_of_theory(share: float, holds: bool) -> None:
    stiffness, mass = 1e5, 1.0
    bound = 2 * math.sqrt(mass / stiffness)  # of semi-implicit Euler on one spring
    energy, _ = flights.simulate_force_based(dt=share * bound, speed=0.05, stiffness=stiffness, mass=mass)
    assert (energy < flights.ENERGY[1]) is holds


def test_summed_jacobi_overshoots_with_the_number_of_contacts() -> None:
    found = flights.contact_count_map(counts=(1, 64))
    outcome = {(cell.panel, cell.x): cell.outcome for cell in found.cells if cell.y == 0.0}
    assert (outcome["Jacobi, summed", 1], outcome["Jacobi, summed", 64]) == ("good", "broken")
    assert outcome["Jacobi, averaged", 64] == outcome["direct (default)", 64] == "good"


def test_gradients_agree_at_the_sizes_of_hands_and_their_objects() -> None:
    found = gradients.gradient_map(sizes=(0.01, 0.04), gaps=(0.1, 0.3), repeats=3)
    assert [cell for cell in found.cells if cell.outcome == "broken"] == []


def test_a_shape_is_refused_or_its_grasps_are_sound(hand: HandModel) -> None:
    defects = ("a side is missing", "inside out")
    opened, inverted = shapes.shape_map(hand, FEW, fidelities=("draft",), families=(), defects=defects).cells
    assert opened.outcome == "refused" and "allow-open" in opened.note
    assert inverted.outcome in ("good", "weak"), inverted.note


def test_a_start_that_is_too_far_is_flagged(pair: Pair) -> None:
    state = descents.starts_of(pair, 2)
    far = HandState(state.pivot + np.array([0.0, 0.0, 0.6]), state.rotation, state.q)
    (cell,) = descents._cells(pair, descents.descend(pair, far, FIDELITIES["draft"]), "x", 0, 0)
    assert cell.outcome == "broken"


def test_a_job_whose_every_grasp_is_bad_ends_with_none(hand: HandModel) -> None:
    crumb = shapes.prepare_mesh(shapes.cube(1), 1e-5)
    request = JobRequest(hand="hand", object="crumb", grasps=2, fidelity="draft", budget=2, rechecks=0)
    found = validated_grasps(hand, crumb, request, count=2)
    assert found.candidates == len(found.grasps) + sum(found.rejected.values())
    assert (found.columns["quality/valid"] == 1).all()


def test_a_long_run_does_not_drift(pair: Pair) -> None:
    drift = descents.descend(pair, descents.starts_of(pair, 2), FIDELITIES["draft"], iterations=1500).drift
    # float32: a normalised quaternion is off by a few units in the last place, 6e-8, and never by nothing at all.
    assert 0 < drift < 1e-6


@pytest.mark.slow
def test_a_quick_run_takes_less_than_the_minute_that_it_promises() -> None:
    started = time.process_time()
    options = {"quick": True, "work": DEFAULT_CONTEXT, "say": lambda line: None}
    found = shapes.run_studies(STUDIES, "allegro", **options)
    assert time.process_time() - started < 60  # CPU seconds: others may keep the machine busy
    assert [one.name for one in found] == list(STUDIES) and all(one.cells for one in found)


@pytest.mark.slow
def test_every_map_of_the_benchmark_has_cells() -> None:
    found = measure(MAPS, quick=True, say=lambda line: None)
    assert [one.name for one in found] == list(MAPS) and all(one.cells for one in found)


def a_map(**changes: object) -> StabilityMap:
    cells = [MapCell("a", 1.0, 10.0, 0.1, "good", reached=True), MapCell("a", 3.0, 10.0, 5.0, "broken")]
    cells.insert(1, MapCell("a", 2.0, 10.0, math.inf, "broken", "why", "", True))
    one = StabilityMap("demo", "A demo", "x", "y", "m", "weak: 1", cells, "it flies", "g", "t", {"a": [(1.0, 10.0)]})
    return replace(one, **changes)


def a_record(*maps: StabilityMap) -> Stability:
    return Stability("2026-11-21T12:00:00.000Z", "graspd stability", {"graspd": "0"}, list(maps or [a_map()]))


def test_a_report_has_pictures_tables_and_says_what_still_breaks(tmp_path) -> None:
    found = [grade(value, 1.0, 2.0) for value in (0.5, 1.5, 2.5, math.nan, math.inf)]
    assert found == ["good", "weak", "broken", "broken", "broken"]
    data, page, picture = write(a_record(), tmp_path)
    assert json.loads(data.read_text())["maps"][0]["cells"][1]["value"] is None
    assert picture.name == "stability-demo.png" and picture.read_bytes().startswith(b"\x89PNG")
    said = page.read_text()
    assert "| a | 1 | 0 | 2 | 0 |" in said and "| A demo | 1 | 0 | 1 | 0 | a 2 (10) | it flies |" in said
    whole = [replace(cell, outcome="good") for cell in a_map().cells]
    assert "| A demo | 2 | 0 | 0 | 0 | nothing | – |" in markdown(a_record(a_map(cells=whole)))


@pytest.mark.parametrize("content", ["{}", '{"maps": 3}'])
def test_wrong_files_and_options_are_the_callers_mistake(tmp_path, content: str) -> None:
    (tmp_path / "wrong.json").write_text(content)
    assert "no stability.json" in refused("stability --from", tmp_path / "wrong.json")
    assert "magic" in refused("stability --only magic")


def tips(hand: HandModel, joints: np.ndarray) -> np.ndarray:
    """(fingers, 3) origins of the last links."""
    poses = body_poses(hand, np.array([[0.0, 0, 0, 1, 0, 0, 0]]), joints[None])
    return np.array([poses[0, body, :3] for body, name in enumerate(hand.body_names) if name.endswith("_2")])


@pytest.mark.parametrize(
    ("coupling", "dofs"), [("each joint", 12), ("distal follows", 8), ("one drive per finger", 4), ("one drive", 1)]
)
def test_a_ring_has_as_many_dofs_as_its_drives(coupling: Coupling, dofs: int) -> None:
    assert ring_hand(4, coupling=coupling).dofs == dofs


def test_fingers_open_outward_scale_and_follow_by_ratio() -> None:
    hand = ring_hand(3)
    postures = (hand.expand(q) for q in (hand.lower, 0.5 * hand.upper))
    wide, closed = (np.linalg.norm(tips(hand, posture)[:, :2], axis=1) for posture in postures)
    assert (wide > 0.06).all() and (closed < 0.03).all()
    small, large = (ring_hand(3, size=size) for size in (1.0, 2.0))
    # The URDF has six decimals of a metre.
    doubled = 2 * tips(small, small.expand(small.lower))
    np.testing.assert_allclose(tips(large, large.expand(large.lower)), doubled, atol=3e-6)
    hand = ring_hand(2, coupling="distal follows", ratio=0.5)
    by_name = dict(zip(hand.joint_names, hand.expand(np.full(hand.dofs, 0.6)), strict=True))
    assert by_name["joint_0_2"] == pytest.approx(0.5 * by_name["joint_0_1"])


def test_palm_without_fingers_is_refused_and_three_of_them_hold() -> None:
    backend.start_warp()
    none, three = hands.hand_map(FEW, fingers=(0, 3), couplings=("distal follows",)).cells
    assert none.outcome == "refused" and three.value > 0
    driven = hands.hand_map(FEW, fingers=(3, 5), couplings=("one drive",)).cells
    assert [cell.outcome for cell in driven] == ["good", "good"]


def validated(monkeypatch: pytest.MonkeyPatch, name: str, amounts: tuple[float, ...]) -> list[MapCell]:
    monkeypatch.setitem(ERRORS, name, replace(ERRORS[name], amounts=amounts))
    backend.start_warp()
    hand, obj = hand_from_path("barrett"), object_from_path("block")
    return model_error_map([hand], obj, MapOptions(3), errors=[name], every=1).cells


def test_the_models_friction_keeps_what_holds_ice_keeps_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    ice, own = validated(monkeypatch, FRICTION, (0.01, 1.0))
    assert (own.value, own.outcome, own.reached) == (1.0, "good", True)
    assert (ice.value, ice.outcome, ice.reached) == (0.0, "broken", False)


@pytest.mark.parametrize("name", ERRORS)
def test_amounts_within_reach_are_those_that_robust_draws(name: str) -> None:
    hand, rng, (axis, amount) = hand_from_path("barrett"), np.random.default_rng(3), AMOUNTS[name]
    drawn = [amount(draw_variant(axis, hand, rng)) for _ in range(400)]
    low, high = ERRORS[name].drawn
    assert low - 1e-9 <= min(drawn) and max(drawn) <= high + 1e-9
    # Draws come near the ends, but for that of nothing: the bounds are no wider than they need be.
    assert high - max(drawn) < 0.2 * (high - low)
    assert low == 0.0 or min(drawn) - low < 0.2 * (high - low)
    # An amount departs along one axis only.
    one = ERRORS[name].variant(hand, ERRORS[name].amounts[-1], np.array([0.6, 0.0, 0.8]))
    assert sum(value != getattr(Variant(), field) for field, value in vars(one).items()) == 1
    assert amount(one) == pytest.approx(ERRORS[name].amounts[-1])


def assert_valid_ones_are_clear(hand: HandModel, found: ValidatedBatch, spec: SceneSpec) -> None:
    """By MuJoCo's distances at the grasp, whatever the planner thinks of its clearance."""
    rows = np.flatnonzero(found.columns["quality/valid"] == 1)
    assert (found.columns["quality/clearance_m"][rows] >= MARGIN_M).all() and spec.target is not None
    for support in supports_of(spec) if len(rows) else ():
        seen = support.in_frame(np.asarray(spec.target, float))
        assert mujoco_room(hand, found.grasps.grasp.take(rows), seen).min() >= MARGIN_M - 1e-6


def test_a_plate_flat_on_a_table_ends_with_fewer_and_says_so(tmp_path) -> None:
    plate = tmp_path / "plate.stl"
    trimesh.creation.box((0.15, 0.15, 0.003)).export(plate)
    words = "synth --hand barrett --units m --scene table --faces all --scenes 1 -n 2 --budget 2 --fidelity draft"
    told = graspd(f"{words} --object", plate, "-o", tmp_path / "g.h5", code=3)
    assert "the budget of 2 candidates" in told["reason"]
    assert "of the candidates are clear" in _format_summary({"file": "g.h5", **told})


@pytest.mark.parametrize("gap", [5, 30])
def test_object_in_a_narrow_well_is_refused_or_comes_out_valid(hand: HandModel, gap: float) -> None:
    sides, spec = scenes._upright_box(scenes.TARGET_MM, scenes._walls(scenes.WALLS["four"], gap))
    try:
        found = scenes.plan_candidates(hand, sides, spec, MapOptions(2))
    except InputError as error:
        assert "\n" not in str(error) and ("no room" in str(error) or "on every side" in str(error))
    else:
        assert_valid_ones_are_clear(hand, found, spec)


def test_a_box_among_boxes_is_lifted_out_or_not_valid(hand: HandModel) -> None:
    sides, spec = scenes._upright_box(scenes.TARGET_MM, scenes._neighbours(scenes.NEIGHBOURS["four"], 120))
    found = scenes.plan_candidates(hand, sides, spec, MapOptions(6))
    assert found.shares["lift_share"] > 0, "with so much room some must come out"
    assert_valid_ones_are_clear(hand, found, spec)


def test_refused_scenes_are_cells_that_say_why_walls_stand_off(hand: HandModel) -> None:
    (cell,) = scenes.scene_map("scene_wall", [hand], MapOptions(2), xs=(-5,), ys=("one",)).cells
    assert cell.outcome == "refused" and "deep in support" in cell.note
    half = np.array(scenes.TARGET_MM[:2]) * scenes.MILLIMETRES / 2
    for boxes in (scenes._walls(scenes.WALLS["four"], 20), scenes._neighbours(scenes.NEIGHBOURS["eight"], 20)):
        for box in boxes:
            away = np.abs(box.pose[:2]) - np.array(box.size[:2]) / 2 - half
            assert away.max() == pytest.approx(0.02)
    # From a BarrettHand's data sheet: 335 mm at most, fingers stretched; the preshape is about two thirds open.
    assert 0.1 < scenes.span_of(hand) < 0.335


@pytest.mark.parametrize(("valid", "outcome"), [([0, 0], "broken"), ([1, 0, 0], "weak"), ([1, 0], "good")])
def test_a_cell_of_a_scene_tells_the_share_of_valid_grasps(valid: list[int], outcome: str) -> None:
    found = SimpleNamespace(columns={"quality/valid": np.array(valid)}, shares={"clear_share": 0.0})
    assert scenes._cell_values(found)[:2] == (np.mean(valid), outcome)  # type: ignore[arg-type]


def test_maps_of_several_runs_are_drawn_and_published_as_one(tmp_path) -> None:
    cells = [MapCell("one", 1.0, "a", 0.5, "good")]
    for name, value in (("first", 1.0), ("second", 2.0)):
        one = StabilityMap("shared", name, "x", "y", "m", "b", cells, "s", "g")
        own = StabilityMap(name, name, "x", "y", "m", "b", cells, "s", "g")
        run = Stability(f"2026-01-0{value:.0f}T00:00:00Z", f"graspd stability {name}", {"graspd": "0"}, [one, own])
        (tmp_path / f"{name}.json").write_text(json.dumps(run.as_json()))
    given = [part for name in ("first", "second") for part in ("--from", tmp_path / f"{name}.json")]
    graspd("stability --publish", *given, "--out", tmp_path / "out", "--data-dir", tmp_path)
    written = json.loads((tmp_path / "out" / "stability.json").read_text())
    assert latest_record(open_store((tmp_path / "store").as_uri()), "stability") == written
    found = parse_stability(written)
    assert {one.name: one.title for one in found.maps} == {"shared": "second", "first": "first", "second": "second"}
    assert found.command == "graspd stability first; graspd stability second"
