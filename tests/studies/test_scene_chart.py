"""Grasps planned in scenes against filtered ones: what is run, what is counted, and that a stopped run goes on."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from graspd.commands.studies import app
from graspd.service.model.studies import FILTERED, IN_SCENE
from graspd.service.pipeline.fidelity_choice import cheapest
from graspd.service.store.records import latest
from graspd.service.store.store import open_store
from graspd.studies.chart.report import markdown
from graspd.studies.chart.scenes import figures, summed
from graspd.worker.quality.intervals import wilson

ARGUMENTS = ("--scene", "table", "--quick", "--methods", "fast_graspd,autograsp", "--hands", "barrett")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    folder = tmp_path_factory.mktemp("chart")
    arguments = [*ARGUMENTS, "--objects", "block", "--work", str(folder / "work"), "--out", str(folder), "--json"]
    done = CliRunner().invoke(app, ["chart", *arguments])
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout.strip().splitlines()[-1]), folder


def test_rates_and_files_are_those_of_the_runs(made: tuple[dict[str, Any], Path]) -> None:
    # Who plans in scenes does both, others are filtered.
    ways = [(run["method"], run["way"]) for run in made[0]["runs"]]
    assert ways == [("fast_graspd", IN_SCENE), ("fast_graspd", FILTERED), ("autograsp", FILTERED)]
    for run in made[0]["runs"]:
        assert 0 <= run["lift_hard_count"] <= run["lift_count"] <= run["clear_count"] <= run["grasps"]
        assert run["valid_per_second"] == pytest.approx(run["lift_count"] / run["seconds"], rel=1e-4)
        assert run["lift_low"] <= run["lift"] <= run["lift_high"]
        assert run["end_seconds"] > run["seconds"] and run["lift_dexgraspbench_count"] <= run["clear_count"]
        assert run["end_to_end_per_second"] == pytest.approx(run["lift_count"] / run["end_seconds"], rel=1e-4)
        assert (run["robust"] is None) == (run["seconds_to_first"] is None) == (run["lift_count"] == 0)
        assert run["robust"] is None or 0 <= run["robust_low"] <= run["robust"] <= run["robust_high"] <= 1
    found, folder = made
    assert json.loads((folder / "chart.json").read_text())["runs"] == found["runs"]
    with (folder / "chart.csv").open() as stream:
        assert [row["method"] for row in csv.DictReader(stream)] == [run["method"] for run in found["runs"]]
    assert (folder / "chart.hands.png").is_file()
    assert (folder / "chart.png").stat().st_size > 10_000 and (folder / "chart.svg").is_file()
    assert f"| {IN_SCENE} | fast_graspd | draft |" in (folder / "chart.md").read_text()


def test_a_run_that_was_stopped_plans_only_what_is_missing(made: tuple[dict[str, Any], Path], monkeypatch) -> None:
    found, folder = made
    kept = sorted((folder / "work").glob("*.json"))
    assert len(kept) == 3
    kept[0].unlink()
    planned = []
    runs = {(run["method"], run["way"]): run for run in found["runs"]}

    def tried(setting: Any, way: str, *_: object) -> dict[str, Any]:
        planned.append((setting.method, way))
        return runs[setting.method, way]

    monkeypatch.setattr("graspd.studies.chart.scenes._tried", tried)
    arguments = [*ARGUMENTS, "--objects", "block", "--work", str(folder / "work"), "--json"]
    again = json.loads(CliRunner().invoke(app, ["chart", *arguments]).stdout.strip().splitlines()[-1])
    assert len(planned) == 1
    assert again["runs"] == found["runs"]


def test_a_chart_of_earlier_is_published_apart_and_drawn(made: tuple[dict[str, Any], Path], tmp_path: Path) -> None:
    found, folder = made
    arguments = ["--from", str(folder / "chart.json"), "--publish", "--data-dir", str(tmp_path), "--out", str(tmp_path)]
    done = CliRunner().invoke(app, ["chart", *arguments])
    assert done.exit_code == 0, done.output
    store = open_store((tmp_path / "store").as_uri())
    stored = latest(store, "scene_charts/table")
    assert stored is not None and stored["runs"] == found["runs"]
    assert latest(store, "charts") is None
    assert (tmp_path / "chart.json").read_bytes() == (folder / "chart.json").read_bytes()
    assert (tmp_path / "chart.md").read_text() == (folder / "chart.md").read_text()
    # What it promises is what a job in such a scene is given.
    draft = next(run for run in found["runs"] if run["way"] == IN_SCENE)
    chosen = cheapest(stored, f"lift>={draft['lift']}", method="fast_graspd", hand="barrett", object_="block")
    assert chosen == ("draft", "hand and object", draft["lift"])


@pytest.mark.parametrize(
    ("content", "words"),
    [("{}", "is no chart.json"), ("no json", "is no chart.json"), ('{"created": "c", "runs": []}', "has no summary")],
)
def test_a_file_that_is_no_chart_is_refused_in_a_line(tmp_path: Path, content: str, words: str) -> None:
    file = tmp_path / "chart.json"
    file.write_text(content)
    done = CliRunner().invoke(app, ["chart", "--from", str(file)])
    assert done.exit_code == 2 and words in " ".join(done.output.split())
    done = CliRunner().invoke(app, ["chart", *ARGUMENTS, "--objects", "block", "--sweep"])
    assert done.exit_code == 2 and "omit --scene" in done.output


def run_of(way: str, pair: str, lifted: int, seconds: float, grasps: int = 10) -> dict[str, Any]:
    counts = {"grasps": grasps, "seconds": seconds, "end_seconds": 2 * seconds, "robust_sum": 0.5 * lifted}
    counts |= dict.fromkeys(("clear_count", "lift_count", "lift_dexgraspbench_count"), lifted) | {"lift_hard_count": 0}
    said = {"way": way, "method": "m", "fidelity": "f", "batch": grasps, "hand": "h", "object": pair, "note": ""}
    return {**said, **counts, **figures([counts]), "scenes": 1, "seconds_to_first": seconds if lifted else None}


def test_gain_is_median_of_pairs_in_which_filtering_found_any() -> None:
    runs = [run_of(IN_SCENE, pair, 8, 2.0) for pair in "abc"]
    runs += [run_of(FILTERED, pair, lifted, 1.0) for pair, lifted in (("a", 1), ("b", 2), ("c", 0))]
    inside, outside = summed(runs)
    assert inside["gain"] == pytest.approx((4 / 1 + 4 / 2) / 2)
    assert (inside["pairs_with_one"], outside["pairs_with_one"]) == (3, 2)
    assert inside["robust"] == 0.5 and (inside["robust_low"], inside["robust_high"]) == pytest.approx(wilson(12, 24))
    assert outside["seconds_to_first"] is None and inside["seconds_to_first"] == 2.0
    assert inside["lift"] == 0.8 and outside["valid_per_second"] == pytest.approx(1.0)


def test_a_pair_that_is_refused_counts_as_tries_without_a_lift() -> None:
    refused = run_of(IN_SCENE, "a", 0, 0.0) | {"note": "nothing can reach it"}
    (row,) = summed([refused, run_of(IN_SCENE, "b", 5, 1.0)])
    assert row["lift"] == 0.25 and row["grasps_per_second"] == pytest.approx(10.0)
    assert row["valid_per_second"] == pytest.approx(5.0)
    chart = {"runs": [refused], "summary": [row], "by_hand": {}, "models": 2, "versions": {"graspd": "0"}}
    said = markdown(chart | {"device": "d", "created": "c", "scene": {"kind": "table", "faces": "all"}})
    assert "## Refused" in said and "nothing can reach it" in said
