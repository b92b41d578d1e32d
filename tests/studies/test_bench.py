"""Benchmarks: rates, grasps as of a job, seeds from a network, the price of what models leave out, a page's recipe."""

import json
import re
import time

import h5py
import numpy as np
import pytest
import trimesh

from benchmarks import learned
from benchmarks.cells import planned
from benchmarks.modelling.common import auc, ranking
from benchmarks.modelling.drops import drops, forearm
from benchmarks.modelling.steps import forward_simulation, step
from graspd.baselines.learned.network import save
from graspd.service.model.domain import JobOptions
from graspd.service.model.fidelity import FIDELITIES
from graspd.service.store.shards import write_shard
from graspd.studies.bench import clock_of, kernel_shares, measure_host_ms
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.generation import validated_grasps
from graspd.worker.grasps import Posture
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.planners.fast_graspd.pairs import pair_of
from graspd.worker.planners.fast_graspd.planner import plan
from graspd.worker.planners.port import PlanRequest
from graspd.worker.quality.probe import probe_of
from graspd.worker.rendering import render
from graspd.worker.scenes import drop
from graspd.worker.simulation.reference import Contacts, World, direct
from tests.conftest import REPOSITORY
from tests.networks import random_network
from tests.worker.commands_run import graspd, refused

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
    assert (tmp_path / "bench.png").read_bytes().startswith(b"\x89PNG")


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
