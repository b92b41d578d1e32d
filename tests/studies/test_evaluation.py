"""`graspd evaluate` and `graspd bench`; benchmarks of learned starts and of simplified models, and a page's recipe."""

import json
import re
import time
from typing import Any

import h5py
import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from benchmarks import learned
from benchmarks.cells import planned
from benchmarks.integrators.reference import Contacts, World, direct
from benchmarks.modelling.common import auc, ranking
from benchmarks.modelling.drops import drops, forearm
from benchmarks.modelling.steps import forward_simulation, step
from graspd.baselines.learned.network import save
from graspd.commands.evaluate import app
from graspd.exchange.inputs import Case, expand_path, load_case
from graspd.service.model.domain import JobOptions
from graspd.service.model.errors import InputError
from graspd.service.model.fidelity import FIDELITIES
from graspd.service.model.transforms import apply, invert
from graspd.service.store.shards import read_shard, write_shard
from graspd.studies.bench import clock_of, kernel_shares, measure_host_ms
from graspd.studies.evaluation import combine_rows, evaluate
from graspd.worker.control.postures import pregrasp, squeeze
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.generation import validated_grasps
from graspd.worker.grasps import GraspSet, Posture
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.surface import piece_distance
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.planners.fast_graspd.pairs import pair_of
from graspd.worker.planners.fast_graspd.planner import plan
from graspd.worker.planners.port import PlanRequest
from graspd.worker.quality.probe import probe_of
from graspd.worker.rendering import render
from graspd.worker.scenes import drop
from tests.conftest import REPOSITORY
from tests.networks import random_network
from tests.worker.commands_run import graspd, refused
from tests.worker.quality.helpers import BOX, pad_hand, posture

CONTRACT = {"n", "protocol", "gsr", "osr", "sgs", "pd_mm", "spd_mm", "ca_cm2", "iv_cm3", "epsilon", "wrench_volume"}
CONTRACT |= {"sd_cm", "diversity"}
HAND = pad_hand()


def plates_case(**kwargs: object) -> Case:
    rows = posture(((0, 0, 0), (0.0655, 0.0655)), ((0, 0, 0.004), (0.0655, 0.0655)), ((0, 0, -0.5), (0.065, 0.065)))
    grasps = GraspSet(rows, pregrasp(HAND, BOX, rows), squeeze(HAND, BOX, rows, total_normal_force=20.0), np.zeros(3))
    return Case("plates", HAND, BOX, grasps, **kwargs)  # type: ignore[arg-type]


def test_row_has_the_contract_s_keys_and_counts_what_holds(tmp_path) -> None:
    row = evaluate(plates_case(seconds=1.0), cache=tmp_path)
    assert set(row) >= CONTRACT and (row["n"], row["gsr"], row["osr"]) == (3, pytest.approx(2 / 3), 1.0)
    assert row["sgs"] < row["sgs_without_validation"] == pytest.approx(2.0)
    assert row["reasons"] == {"held": 2, "displaced under +x": 1}
    json.dumps(row, allow_nan=False)
    first, _, last = row["verdicts"]
    assert first["outcomes"] == ["held"] * 6 and first["margin"] < 1 and last.pop("margin") > 1
    outcomes = ["displaced"] + ["not_tried"] * 5
    assert last == {"row": 2, "held": False, "outcomes": outcomes, "reason": "displaced under +x"}


def test_what_holds_is_validated_in_other_models_when_asked(tmp_path) -> None:
    row = evaluate(plates_case(), models=3, cache=tmp_path)
    assert (row["robust_models"], row["robust_n"]) == (3, 2)
    shares = [one["robust_share"] for one in row["verdicts"]]
    assert row["robust_share"] == pytest.approx(np.mean(shares[:2]), abs=1e-6)
    assert shares[2] is None, "it does not hold in the nominal model"
    axes = row["robust_axes"]
    assert sum(one["n"] for one in axes.values()) == 6
    assert sum(one["share"] * one["n"] for one in axes.values()) == pytest.approx(6 * row["robust_share"], abs=1e-4)
    assert [(one["robust_weakest"] is None) for one in row["verdicts"]] == [share in (None, 1.0) for share in shares]
    json.dumps(row, allow_nan=False)
    whole = combine_rows([row, {**row, "robust_n": 4, "robust_share": 0.0}])
    assert whole["robust_share"] == pytest.approx(row["robust_share"] / 3, abs=1e-6)
    assert whole["robust_axes"] == {axis: {"share": one["share"], "n": 2 * one["n"]} for axis, one in axes.items()}
    assert "robust_share" not in evaluate(plates_case(), cache=tmp_path)


@pytest.mark.parametrize("protocol, level", [("lift", "standard"), ("dexgraspbench", "lift"), ("push", "")])
def test_a_level_that_the_protocol_lacks_is_refused(protocol: Any, level: str) -> None:
    with pytest.raises(InputError, match=r"unknown (level|protocol)"):
        evaluate(plates_case(), protocol=protocol, level=level)


def test_published_results_agree_where_they_are_known(tmp_path) -> None:
    row = evaluate(plates_case(), protocol="displacement", cache=tmp_path)
    assert row["gsr"] is None and row["sd_cm"] < 1.0
    row = evaluate(plates_case(published=np.array([1, 0, -1], np.int8)), cache=tmp_path)
    assert row["agreement_published"] == 0.5
    whole = combine_rows([row, {**row, "agreement_published": 0.0, "published": 6}])
    assert whole["agreement_published"] == pytest.approx((2 * 0.5 + 6 * 0.0) / 8)


def test_several_objects_are_weighed_and_seconds_add_up(tmp_path) -> None:
    row = evaluate(plates_case(), cache=tmp_path)
    whole = combine_rows([row, {**row, "n": 1, "gsr": 0.0, "osr": 0.0}])
    assert (whole["n"], whole["gsr"], whole["osr"]) == (4, pytest.approx(0.5), 0.5)
    timed = {**row, "sgs": 1.0, "sgs_without_validation": 2.0}
    whole = combine_rows([timed, {**timed, "sgs": 0.5, "sgs_without_validation": 1.0}])
    # Two held grasps in 2 s and two in 4 s; without the validator in 1 s and in 2 s.
    assert (whole["sgs"], whole["sgs_without_validation"]) == pytest.approx((4 / 6, 4 / 3))
    validated = evaluate(plates_case(seconds=1.0, validated=True), cache=tmp_path)
    assert (validated["sgs"], validated["sgs_without_validation"]) == (pytest.approx(2.0), None)
    whole = combine_rows([row, {**row, "mu": 0.5}])
    assert whole["mu"] is None and "clear_share" not in whole
    clear = [{**row, "clear_share": 1.0}, {**row, "n": 1, "clear_share": 0.0}]
    assert combine_rows(clear)["clear_share"] == pytest.approx(row["n"] / (row["n"] + 1))
    assert whole["level"] == "standard"


def test_published_contacts_lie_on_fingertips_as_we_pose_them(shared_data) -> None:
    found = expand_path(shared_data / "reference_grasps")
    assert len(found) == 8
    file = next(file for file in found if file.name == "056_tennis_ball.json")
    case, stored = load_case(file), json.loads(file.read_text())["grasps"]
    assert (case.published == 1).mean() == pytest.approx(0.91, abs=0.005)
    bodies = body_poses(case.hand, case.grasps.grasp.hand_pose, case.grasps.grasp.joint_positions)
    tips = [p for p in case.hand.pieces if p.body in case.hand.fingertips and "tip" in p.link]
    for row, grasp in zip(bodies, stored, strict=True):
        for point in np.array(grasp["contact_points_object"]):
            nearest = min(abs(float(piece_distance(p, apply(invert(row[p.body]), point[None]))[0])) for p in tips)
            # Fingertip meshes are reduced to 50 corners, which moves their surface by a fraction of a millimetre.
            assert nearest < 5e-4


def test_the_command_prints_json_or_a_table(shared_data) -> None:
    file = shared_data / "reference_grasps" / "frogger_allegro" / "056_tennis_ball.json"
    row = graspd("evaluate --level fast", file)
    assert set(row) >= CONTRACT and row["level"] == "fast"
    # The ball's published pick success is 0.91; ours must be in the same region for the same grasps.
    assert row["gsr"] == pytest.approx(0.91, abs=0.1)
    done = CliRunner().invoke(app, [str(file), "--protocol", "displacement"])
    assert done.exit_code == 0, done.output
    assert "056_tennis_ball" in done.stdout and "not validated" in done.stdout


def test_engines_are_compared_and_a_copy_has_their_columns(tmp_path) -> None:
    made, copy = tmp_path / "g.h5", tmp_path / "copy.h5"
    graspd("synth --hand barrett --object block --fidelity draft -n 2 --want candidates -o", made)
    found = graspd("evaluate --engine mujoco -o", copy, made)
    held = read_shard(made, kind="base").arrays["quality/success"]
    assert found["files"][0]["held"] == {"mujoco": held.tolist()} and found["pairs"] == []
    assert found["success"] == {"mujoco": pytest.approx(held.mean(), abs=1e-4)}
    shard = read_shard(copy, kind="base")
    assert shard.arrays["quality/held_in"].tolist() == held.tolist() and shard.attributes["engines"] == "mujoco"
    assert (shard.arrays["quality/agreement"] == 1).all()
    done = CliRunner().invoke(app, [str(made), "--engines", "mujoco"])
    assert done.exit_code == 0 and f"| g | 2 | {held.mean():.3f} |" in done.stdout, done.output
    rows = graspd("studies engines --engines mujoco --out", tmp_path / "study", made)["rows"]
    assert [(row["friction"], row["n"]) for row in rows] == [("full", 2), ("half", 2)]
    page = (tmp_path / "study" / "engines.md").read_text()
    assert rows[0]["success"] == found["success"] and "| free | full | 2 |" in page
    words = "studies engines --engines mujoco --hands barrett --objects block --scenes table -n 1 --out"
    rows = graspd(words, tmp_path / "planned")["rows"]
    assert [(row["hand"], row["scene"], row["n"]) for row in rows] == [("barrett", "table", 1)] * 2


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ("--level quick", "unknown"),
        ("--protocol throw", "unknown"),
        ("--engines mujoco,havok", "unknown engine 'havok'"),
        ("--engine mujoco --robust 8", "without --robust"),
    ],
)
def test_options_that_exclude_each_other_are_refused(options: str, says: str) -> None:
    assert says in refused(f"evaluate grasps.h5 {options}")


RUN_KEYS = {"fidelity", "batch", "processes", "hand_points", "faces", "iterations", "ms_per_iteration"}
RUN_KEYS |= {"grasps_per_second", "peak_memory_mb"}
PAGE = (REPOSITORY / "docs" / "explanation" / "modelling.md").read_text()


def test_every_run_has_the_keys_of_the_contract_and_adds_up(tmp_path) -> None:
    words = "bench --hand barrett --object block --fidelity draft --batch 1 --batch 4 --join 1 --join 2 --threads 1"
    found = graspd(f"{words} --repeats 1 --out", tmp_path)
    assert found["device"]
    runs, host = found["runs"], found["host_ms_per_grasp"]
    assert [(run["batch"], run["join"]) for run in runs] == [(1, 1), (1, 2), (4, 1), (4, 2)]
    for run in runs:
        assert set(run) >= RUN_KEYS
        assert run["grasps_per_second"] == pytest.approx(run["batch"] * run["join"] / run["seconds"], rel=0.01)
        assert run["ms_per_iteration"] == pytest.approx(1e3 * run["seconds"] / run["iterations"], rel=0.01)
    assert 0.0 < host < max(1e3 * run["seconds"] / run["grasps"] for run in runs)
    assert json.loads((tmp_path / "bench.json").read_text())["runs"] == runs
    assert "| draft | 2 × 4 |" in (tmp_path / "bench.md").read_text()


def test_kernels_are_no_time_of_the_host_and_their_shares_add_up() -> None:
    hand, obj, fidelity, count = hand_from_path("barrett"), object_from_path("block"), FIDELITIES["draft"], 16
    host = measure_host_ms(hand, obj, fidelity, count)
    began = time.thread_time()
    plan(hand, obj, PlanRequest(count, fidelity, seed=0), ExecutionContext("cpu", threads=1))
    assert host < 0.5 * 1e3 * (time.thread_time() - began) / count
    pair = pair_of(hand, obj, fidelity, "cpu")
    for phase in kernel_shares(pair, fidelity, 4).values():
        assert sum(phase["share"].values()) == pytest.approx(1.0, abs=2e-3) and phase["share"]["gather"] > 0
        assert 1 <= phase["iterations_to_convergence"] <= fidelity.coarse_iterations
        assert phase["queries_per_second"] > 0
    # On a GPU a process only waits: there the seconds count that pass.
    assert (clock_of("cpu"), clock_of("cuda:0")) == (time.process_time, time.perf_counter)


def test_unknown_fidelities_and_no_networks_are_told(tmp_path, capsys: pytest.CaptureFixture[str]) -> None:
    refused("bench --fidelity superb")
    (tmp_path / "net.npz").write_bytes(b"no network")
    assert learned.main(["--network", str(tmp_path / "net.npz")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_study_plans_the_grasps_of_a_job() -> None:
    wish = JobOptions(want="candidates", fidelity="draft", seed=5, rechecks=0)
    hand, obj = hand_from_path("barrett"), object_from_path("block", face_error_m=wish.resolved_fidelity.face_error_m)
    made = validated_grasps(hand, obj, wish, count=2).grasps
    found = planned(hand, obj, count=2, seed=5, fidelity="draft")
    assert np.array_equal(found.grasp.hand_pose, made.grasp.hand_pose)
    assert np.array_equal(found.squeeze.joint_positions, made.squeeze.joint_positions)


def test_both_methods_are_told_side_by_side(tmp_path, monkeypatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(learned, "BUDGET", 2.0)
    hand = hand_from_path("barrett")
    save(random_network(hand.joint_names, hand=hand.name, digest=hand.digest), tmp_path / "net.npz")
    words = ["--network", str(tmp_path / "net.npz"), "--objects", "block", "--many", "2", "--seeds", "1"]
    assert learned.main([*words, "--starts", "2", "--out", str(tmp_path / "out")]) == 0
    found = json.loads((tmp_path / "out" / "learned.json").read_text())
    own, other = found["rows"]
    assert [own["method"], other["method"]] == ["fast_graspd", "learned starts=2"]
    for row in found["rows"]:
        assert (row["hand"], row["object"]) == ("barrett", "block")
        assert row["first"] == pytest.approx(row["firsts"][0], abs=1e-3) and row["first"] > 0 and row["found"] in (0, 1)
        assert row["rate"] == pytest.approx(2 * row["valid"] / row["seconds"])
    assert list(found["networks"].values()) == ["barrett. drawn by chance"]
    page = (tmp_path / "out" / "learned.md").read_text()
    assert learned.table(found["rows"]) in page and learned.table(found["rows"]) + "\n" == capsys.readouterr().out
    assert str(tmp_path) not in page


def test_a_step_is_that_of_the_reference() -> None:
    rng = np.random.default_rng(3)
    points = rng.normal(scale=0.03, size=(12, 3))
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    distance, weight = rng.normal(scale=4e-4, size=12), rng.uniform(0.5, 2.0, size=12)
    world = World(inertia=np.diag([4e-4, 5e-4, 6e-4]), gyration=0.022)
    motion = np.array([1e-3, 0, 0, 0, 0, 0])
    expected = direct(Contacts(points, normals, distance, weight), motion, world, passes=4)
    # Both are float64 and differ in the order of sums only.
    found = step(points, normals, distance, weight, motion, world, world.inertia, passes=4)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-15)


def test_an_object_that_nothing_touches_moves_on_freely() -> None:
    hand, obj = hand_from_path("allegro"), object_from_path("block")
    probe = probe_of(hand, obj, hand_points=100, object_points=64)
    far = Posture(np.array([[5.0, 0, 0, 1, 0, 0, 0]]), hand.expand(np.zeros((1, hand.dofs))))
    world = World(inertia=obj.inertia, gyration=obj.gyration_radius)
    # Six of seven velocities move by one step each; norms are smoothed by 1 % of a step, twice.
    np.testing.assert_allclose(forward_simulation(probe, far, world, (1, 4)), [[6 / 7, 24 / 7]], atol=0.03)


def test_rankings_count_what_is_told_apart() -> None:
    for score, expected in (([1, 2, 3, 4], 1.0), ([4, 3, 2, 1], 0.0), ([1, 1, 1, 1], 0.5)):
        assert auc(np.array(score, float), np.array([False, False, True, True])) == expected
    found = ranking([np.arange(6.0), np.zeros(4)], [np.arange(6) > 2, np.ones(4, bool)])
    assert (found["value"], found["n"]) == (1.0, 6)


def test_convex_objects_fall_as_their_hull_forearms_end_below() -> None:
    (found,) = drops([object_from_path("block")], 4)
    assert (found["pieces"], found["same_face"]["value"], found["distance"]) == (1, 1.0, 0.0)
    half = np.sqrt(0.5)
    # Fingers up, fingers down, lying on its side; the root half a metre above the table.
    turns = [[1, 0, 0, 0], [0, 1, 0, 0], [half, half, 0, 0]]
    lowest, slope = forearm(np.array([[0, 0, 0.5, *turn] for turn in turns]), np.zeros(3))
    np.testing.assert_allclose(lowest, [0.2, 0.8, 0.46], atol=1e-12)
    np.testing.assert_allclose(slope, [-1, 1, 0], atol=1e-12)


def test_pages_recipe_finds_point_of_the_mesh_behind_each_pixel(tmp_path) -> None:
    obj = object_from_path("block")
    poses = drop(obj, count=1, seed=2)["scene/object_pose"]
    small = {"views": 1, "stereo": False, "width": 40, "height": 30, "samples": 2}
    arrays = render(obj, poses, **small, seed=3, run=ExecutionContext(threads=1))
    (tmp_path / "views.h5").write_bytes(write_shard("views", arrays, {}))
    with h5py.File(tmp_path / "scenes.h5", "w") as file:
        file["scene/object_pose"] = poses
    (recipe,) = re.findall(r"```python\n(.*?)```", PAGE, re.S)
    names = {}
    exec(recipe, names)
    points = names["object_points"](tmp_path / "views.h5", tmp_path / "scenes.h5", 0)
    seen = points[arrays["image/segmentation"][0] == 2]
    mesh = trimesh.Trimesh(obj.vertices, obj.faces, process=False)
    # Depth is float32 at half a metre: 0.1 mm is a thousand times its rounding, and far below a pixel's width.
    assert len(seen) > 50 and np.abs(trimesh.proximity.closest_point(mesh, seen)[1]).max() < 1e-4
