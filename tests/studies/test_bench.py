"""Benchmarks measure what they say: the planner's rate, grasps as of a job, and seeds from a network."""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks import learned
from benchmarks.cells import planned
from graspd.baselines.learned.network import save
from graspd.commands.studies import app
from graspd.service.model.domain import JobOptions
from graspd.service.model.fidelity import FIDELITIES
from graspd.studies.bench import clock_of, host_ms, kernel_shares
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.generation import validated_grasps
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.planners.fast_graspd.pairs import pair_of
from graspd.worker.planners.fast_graspd.planner import plan
from graspd.worker.planners.port import PlanRequest
from tests.networks import random_network

RUN_KEYS = {"fidelity", "batch", "processes", "hand_points", "faces", "iterations", "ms_per_iteration"}
RUN_KEYS |= {"grasps_per_second", "peak_memory_mb"}


def test_every_run_has_the_keys_of_the_contract_and_adds_up(tmp_path: Path) -> None:
    words = "bench --hand barrett --object block --fidelity draft --batch 1 --batch 4 --join 1 --join 2 --threads 1"
    done = CliRunner().invoke(app, [*words.split(), "--repeats", "1", "--out", str(tmp_path), "--json"])
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout.strip().splitlines()[-1])
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
    host = host_ms(hand, obj, fidelity, count)
    began = time.thread_time()
    plan(hand, obj, PlanRequest(count, fidelity, seed=0), ExecutionContext("cpu", threads=1))
    assert host < 0.5 * 1e3 * (time.thread_time() - began) / count
    pair = pair_of(hand, obj, fidelity, "cpu")
    for phase in kernel_shares(pair, fidelity, 4).values():
        assert sum(phase["share"].values()) == pytest.approx(1.0, abs=2e-3)
        assert phase["share"]["gather"] > 0
        assert 1 <= phase["iterations_to_convergence"] <= fidelity.coarse_iterations
        assert phase["queries_per_second"] > 0
    # On a GPU a process only waits: there the seconds count that pass.
    assert (clock_of("cpu"), clock_of("cuda:0")) == (time.process_time, time.perf_counter)


def test_unknown_fidelities_and_no_networks_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert CliRunner().invoke(app, ["bench", "--fidelity", "superb"]).exit_code == 2
    (tmp_path / "net.npz").write_bytes(b"no network")
    assert learned.main(["--network", str(tmp_path / "net.npz")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_study_plans_the_grasps_of_a_job() -> None:
    wish = JobOptions(want="candidates", fidelity="draft", seed=5, rechecks=0)
    hand, obj = hand_from_path("barrett"), object_from_path("block", face_error_m=wish.knobs.face_error_m)
    made = validated_grasps(hand, obj, wish, count=2).grasps
    found = planned(hand, obj, count=2, seed=5, fidelity="draft")
    assert np.array_equal(found.grasp.hand_pose, made.grasp.hand_pose)
    assert np.array_equal(found.squeeze.joint_positions, made.squeeze.joint_positions)


def test_both_methods_are_told_side_by_side(tmp_path: Path, monkeypatch, capsys: pytest.CaptureFixture[str]) -> None:
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
