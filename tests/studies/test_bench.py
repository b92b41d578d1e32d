"""The benchmark's contract, and that it measures what it says."""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest
from typer.testing import CliRunner

from graspd.commands.studies import app
from graspd.service.model.fidelity import FIDELITIES
from graspd.studies.timing import host_ms, kernel_shares
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.planners.fast_graspd.pairs import pair_of
from graspd.worker.planners.fast_graspd.planner import plan
from graspd.worker.planners.port import PlanRequest

RUN_KEYS = {
    "fidelity",
    "batch",
    "processes",
    "hand_points",
    "faces",
    "iterations",
    "ms_per_iteration",
    "grasps_per_second",
    "peak_memory_mb",
}


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, object], Path]:
    out = tmp_path_factory.mktemp("bench")
    arguments = ["--hand", "barrett", "--object", "block", "--fidelity", "draft", "--batch", "1", "--batch", "4"]
    arguments += ["--join", "1", "--join", "2"]
    done = CliRunner().invoke(
        app, ["bench", *arguments, "--threads", "1", "--repeats", "1", "--out", str(out), "--json"]
    )
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout.strip().splitlines()[-1]), out


def test_every_run_has_the_keys_of_the_contract(result: tuple[dict[str, object], Path]) -> None:
    found, _ = result
    assert found["device"]
    runs = found["runs"]
    assert isinstance(runs, list) and [(run["batch"], run["join"]) for run in runs] == [(1, 1), (1, 2), (4, 1), (4, 2)]
    assert all(set(run) >= RUN_KEYS for run in runs)


def test_the_rate_is_that_of_all_batches_of_a_launch(result: tuple[dict[str, object], Path]) -> None:
    runs = result[0]["runs"]
    assert isinstance(runs, list)
    for run in runs:
        assert run["grasps_per_second"] == pytest.approx(run["batch"] * run["join"] / run["seconds"], rel=0.01)
        assert run["ms_per_iteration"] == pytest.approx(1e3 * run["seconds"] / run["iterations"], rel=0.01)


def test_the_host_takes_some_of_the_time_of_a_grasp_and_not_all(result: tuple[dict[str, object], Path]) -> None:
    host, runs = result[0]["host_ms_per_grasp"], result[0]["runs"]
    assert isinstance(runs, list) and isinstance(host, float)
    assert 0.0 < host < max(1e3 * run["seconds"] / run["grasps"] for run in runs)


def test_kernels_on_the_processor_are_no_time_of_the_host() -> None:
    hand, obj, fidelity, count = hand_from_path("barrett"), object_from_path("block"), FIDELITIES["draft"], 16
    host = host_ms(hand, obj, fidelity, count)
    began = time.thread_time()
    plan(hand, obj, PlanRequest(count, fidelity, seed=0), ExecutionContext("cpu", threads=1))
    assert host < 0.5 * 1e3 * (time.thread_time() - began) / count


def test_json_table_and_plot_are_written(result: tuple[dict[str, object], Path]) -> None:
    found, out = result
    assert json.loads((out / "bench.json").read_text())["runs"] == found["runs"]
    assert "| draft | 2 × 4 |" in (out / "bench.md").read_text()
    assert (out / "bench.png").read_bytes().startswith(b"\x89PNG")


def test_kernel_shares_add_up_and_the_distance_query_is_among_them() -> None:
    fidelity = FIDELITIES["draft"]
    pair = pair_of(hand_from_path("barrett"), object_from_path("block"), fidelity, "cpu")
    for phase in kernel_shares(pair, fidelity, 4).values():
        assert sum(phase["share"].values()) == pytest.approx(1.0, abs=2e-3)
        assert phase["share"]["gather"] > 0
        assert 1 <= phase["iterations_to_convergence"] <= fidelity.coarse_iterations
        assert phase["queries_per_second"] > 0


def test_an_unknown_fidelity_is_the_callers_mistake() -> None:
    done = CliRunner().invoke(app, ["bench", "--fidelity", "superb"])
    assert done.exit_code == 2
