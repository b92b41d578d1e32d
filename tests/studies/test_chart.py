"""The chart: its contract and statistics, of free grasps and in scenes; a sweep changes only what it names."""

import csv
import itertools
import json
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text

from benchmarks.scenes_chart.__main__ import main as scenes_chart
from benchmarks.scenes_chart.__main__ import scene_of
from benchmarks.scenes_chart.comparison import lift_figures
from benchmarks.scenes_chart.comparison import summarise_runs as summed_in_scenes
from benchmarks.scenes_chart.report import markdown as scenes_page
from benchmarks.sweeps.__main__ import main as sweep
from benchmarks.sweeps.settings import KnobValue, knob_values, plan_value, query_per_velocity
from graspd.service.model.errors import InputError
from graspd.service.model.fidelity import FIDELITIES
from graspd.service.model.studies import FILTERED, IN_SCENE
from graspd.service.pipeline.fidelity_choice import cheapest_fidelity
from graspd.service.store.records import latest_record
from graspd.service.store.store import open_store
from graspd.studies.chart.chart import settings_of
from graspd.studies.chart.figure import Label, place_labels
from graspd.studies.chart.report import markdown
from graspd.studies.chart.statistics import METRICS, seconds_to_valid, summarise_runs
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.quality.intervals import wilson_interval
from tests.worker.commands_run import graspd, refused

RUN_KEYS = {"method", "fidelity", "hand", "object", "valid_per_second", "seconds_to_first_valid", "gsr", "epsilon"}
RUN_KEYS |= {"pd_mm", "end_to_end_per_second", "dexgraspbench", "hard", "robust"}
QUICK = "chart --quick --methods fast_graspd,autograsp --hands barrett --objects block"
CROWDS = {
    "beside each other": [(10.0, 0.98), (13.0, 0.95), (14.0, 0.93), (22.0, 0.94)],
    "above each other": [(5.0, 0.50), (5.0, 0.52), (5.0, 0.54), (5.1, 0.48)],
    "in the corners": [(1.0, 0.0), (100.0, 1.0), (1.0, 1.0), (100.0, 0.0)],
    "at the same place": [(3.0, 0.3), (3.0, 0.3), (3.0, 0.3)],
}
ON_TABLE = ["--quick", "--methods", "fast_graspd", "autograsp", "--hands", "barrett", "--objects", "block"]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict, Path]:
    folder = tmp_path_factory.mktemp("chart")
    return graspd(f"{QUICK} --publish --data-dir", folder / "data", "--out", folder), folder


def test_runs_have_the_rates_that_their_counts_and_seconds_give(made: tuple[dict, Path]) -> None:
    runs = made[0]["runs"]
    assert [run["fidelity"] for run in runs] == ["draft", "as published"]
    for run in runs:
        assert set(run) >= RUN_KEYS
        used = sum(run["seconds"])
        # Seconds are printed to the microsecond, the rate is not rounded so.
        rounded = 0.5e-6 * len(run["seconds"]) / used
        assert run["valid_per_second"] == pytest.approx(run["valid"] / used, rel=1e-5 + rounded)
        assert run["gsr"] == pytest.approx(run["valid"] / run["grasps"]) and run["kept"] <= run["valid"]
        assert all(whole > planned for whole, planned in zip(run["end_seconds"], run["seconds"], strict=True))
        assert run["end_to_end_per_second"] == pytest.approx(run["kept"] / sum(run["end_seconds"]), rel=1e-4)
        for key in ("gsr", "dexgraspbench", "hard", "end_to_end_per_second", *(["robust"] if run["valid"] else [])):
            assert run[f"{key}_low"] <= run[key] <= run[f"{key}_high"], key
        assert (run["robust"] is None) == (run["valid"] == 0)
    assert set(made[0]["by_hand"]) == {"barrett"} and made[0]["models"] == 2
    assert made[0]["by_hand"]["barrett"] == made[0]["summary"]


def assert_written(folder: Path, found: dict, column: str) -> None:
    assert json.loads((folder / "chart.json").read_text())["runs"] == found["runs"]
    rows = list(csv.DictReader((folder / "chart.csv").read_text().splitlines()))
    assert [row[column] for row in rows] == [str(run[column]) for run in found["runs"]]
    assert all((folder / name).read_bytes().startswith(b"\x89PNG") for name in ("chart.png", "chart.hands.png"))
    assert "<svg" in (folder / "chart.svg").read_text()


def test_all_files_are_written_and_agree(made: tuple[dict, Path]) -> None:
    found, folder = made
    assert_written(folder, found, "gsr")
    assert "The best ten by epsilon" in (folder / "chart.md").read_text()
    stored = latest_record(open_store((folder / "data" / "store").as_uri()), "charts")
    assert stored is not None and stored["runs"] == found["runs"]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("--methods magic", "magic"),
        ("--methods graspit@", "write NAME, NAME:OPTION=VALUE"),
        ("--fidelities superb", "superb"),
        ("--batch many", "many"),
        ("--hands ,", "an option is empty"),
        ("--option steps=3", "steps"),
        ("--methods graspit --option graspit:steps=1", "steps"),
        ("--objects nowhere.stl", "nowhere.stl"),
    ],
)
def test_a_wrong_option_is_the_callers_mistake(words: str, says: str) -> None:
    assert says in refused(f"chart --quick {words}")


def test_a_chart_in_scenes_with_neighbours_is_refused(tmp_path: Path) -> None:
    (tmp_path / "s.json").write_text('{"supports": [{"kind": "half_space"}], "neighbours": [{"object": "block"}]}')
    with pytest.raises(InputError, match="neighbours, which a chart does not support"):
        scene_of(str(tmp_path / "s.json"))


def test_method_can_be_charted_with_options_and_batch_of_its_own() -> None:
    given = {"batches": [32], "baseline_batch": 4, "options": ["graspit:steps=40000"], "quick": False}
    methods, run = ["graspit", "graspit:keep=5@10"], ExecutionContext(threads=1)
    plain, kept = settings_of(methods, ["draft"], **given, run=run)
    assert (plain.fidelity, plain.batch, plain.options) == ("as published", 4, {"steps": "40000"})
    assert (kept.fidelity, kept.batch, kept.options) == ("keep=5", 10, {"steps": "40000", "keep": "5"})


def test_the_first_valid_grasp_takes_the_calls_of_a_coin() -> None:
    """Against 20,000 simulated waits; standard error below 1 %."""
    share, grasps = 0.3, 2
    waits = np.random.default_rng(1).geometric(1 - (1 - share) ** grasps, size=20_000)
    assert seconds_to_valid(share, [1.5, 9.0, 1.4], grasps) == pytest.approx(1.5 * waits.mean(), rel=0.02)
    assert seconds_to_valid(0.0, [1.5], grasps) is None


def run_of(method: str, valid: int, seconds: float, pd: float) -> dict:
    row = {"method": method, "fidelity": "standard", "batch": 10, "grasps": 10, "valid": valid}
    row |= {"seconds": [seconds], "seconds_to_first_valid": seconds if valid else None, "gsr": valid / 10}
    row |= {"dexgraspbench": valid / 10, "hard": valid / 20, "robust": 0.5 if valid else None}
    row |= {"epsilon": 0.1, "pd_mm": pd, "valid_per_second": valid / seconds}
    row |= {"kept": valid, "end_seconds": [2 * seconds], "end_to_end_per_second": valid / seconds / 2}
    for key in (*METRICS, "valid_per_second", "end_to_end_per_second"):
        row |= {f"{key}_low": row[key], f"{key}_high": row[key]}
    return row


def test_sums_divide_all_valid_by_all_seconds() -> None:
    (row,) = summarise_runs([run_of("a", 8, 1.0, 0.1), run_of("a", 2, 4.0, 0.3)])
    assert row["valid_per_second"] == pytest.approx(10 / 5.0)
    assert row["end_to_end_per_second"] == pytest.approx(10 / 10.0)
    assert row["gsr"] == row["dexgraspbench"] == pytest.approx(0.5) and row["pd_mm"] == pytest.approx(0.2)
    able, unable = summarise_runs([run_of("a", 5, 1.0, 0.5), run_of("b", 0, 0.1, 0.0)])
    assert able["front"] == ["dexgraspbench", "hard", "robust", "gsr", "epsilon", "pd_mm"]
    assert unable["front"] == [] and unable["robust"] is None and unable["seconds_to_first_valid"] is None
    fast, gentle = summarise_runs([run_of("a", 5, 1.0, 0.5), run_of("b", 5, 2.0, 0.1)])
    assert "pd_mm" in fast["front"] and gentle["front"] == ["pd_mm"]


def test_a_ratio_to_a_method_without_a_valid_grasp_is_a_bound() -> None:
    """5 valid/s against 0 of 10 at 50 grasps/s: at most 3 of 10 hold, so at least a third of a time more."""
    rows = summarise_runs([run_of("fast_graspd", 10, 1.0, 0.5), run_of("graspit", 0, 0.1, 0.0)])
    chart = {"summary": rows, "runs": [], "by_hand": {}, "models": 8, "friction": 1.0, "threshold_m": 0.005}
    chart |= {"created": "", "device": "", "threads": 2, "versions": {"graspd": "", "warp": ""}}
    assert "> × 0.333 (0 of 10 valid)" in markdown(chart | {"validation": {"level": ""}})


def test_each_knob_has_its_default_once_and_can_be_turned_alone() -> None:
    found = knob_values()
    for knob in {turn.knob for turn in found}:
        assert sum(turn.is_default for turn in found if turn.knob == knob) == 1
    assert [turn.value for turn in knob_values(knobs=["queries"])] == ["shared", "one per velocity"]
    with pytest.raises(InputError, match="no setting 'volume'; choose from 'hand points'"):
        knob_values(knobs=["volume"])


def test_a_sweep_has_a_row_per_value_relative_to_the_default(tmp_path: Path) -> None:
    sweep(["--quick", "--hand", "barrett", "--object", "block", "--only", "queries", "--out", str(tmp_path)])
    rows = json.loads((tmp_path / "sweeps.json").read_text())["rows"]
    assert [(row["value"], row["default"]) for row in rows] == [("shared", True), ("one per velocity", False)]
    assert rows[0]["speedup"] == 1.0
    assert rows[1]["speedup"] == pytest.approx(rows[1]["grasps_per_second"] / rows[0]["grasps_per_second"], rel=1e-4)
    assert "| queries | shared (default) |" in (tmp_path / "sweeps.md").read_text()
    assert (tmp_path / "sweeps.png").read_bytes().startswith(b"\x89PNG")


def test_asking_for_distances_anew_changes_no_grasp() -> None:
    hand, obj = hand_from_path("barrett"), object_from_path("block")
    little = FIDELITIES["draft"].model_copy(update={"coarse_iterations": 12, "fine_iterations": 5})
    shared, anew = (
        plan_value(hand, obj, 2, 0, turn=KnobValue("queries", "", little, change), run=ExecutionContext(threads=1))
        for change in (None, query_per_velocity)
    )
    np.testing.assert_array_equal(shared.grasp.hand_pose, anew.grasp.hand_pose)
    np.testing.assert_array_equal(shared.grasp.joint_positions, anew.grasp.joint_positions)


def drawn(points: list[tuple[float, float]]) -> tuple:
    figure = Figure(figsize=(5.0, 4.0), layout="constrained")
    axes = figure.subplots()
    axes.set_xscale("log")
    axes.set_xlim(0.8, 130.0)
    axes.set_ylim(-0.07, 1.07)
    words = place_labels(figure, [Label(axes, x, y, "draft 9", "black", y_bar=(y - 0.03, y + 0.03)) for x, y in points])
    figure.draw_without_rendering()
    return axes, words


@pytest.mark.parametrize("crowd", CROWDS)
def test_no_word_lies_on_another_or_on_a_point_or_outside(crowd: str) -> None:
    axes, words = drawn(CROWDS[crowd])
    boxes = [Text.get_window_extent(word) for word in words]  # without the lines that lead to them
    assert len(boxes) == len(CROWDS[crowd])
    for one, other in itertools.combinations(boxes, 2):
        assert one.x1 <= other.x0 or other.x1 <= one.x0 or one.y1 <= other.y0 or other.y1 <= one.y0
    panel = axes.get_window_extent()
    for box in boxes:
        assert not any(box.contains(x, y) for x, y in axes.transData.transform(CROWDS[crowd]))
        assert panel.x0 - 1 <= box.x0 and box.x1 <= panel.x1 + 1 and panel.y0 - 1 <= box.y0 and box.y1 <= panel.y1 + 1


def test_a_word_alone_stands_close_to_its_point() -> None:
    axes, (word,) = drawn([(10.0, 0.5)])
    box, point = word.get_window_extent(), axes.transData.transform((10.0, 0.5))
    assert not axes.patches and 0 < box.x0 - point[0] < 15 and 0 < box.y0 - point[1] < 15


@pytest.fixture(scope="module")
def in_scenes(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict, Path]:
    folder = tmp_path_factory.mktemp("chart")
    publish = ["--publish", "--data-dir", str(folder / "data")]
    return scenes_chart([*ON_TABLE, "--work", str(folder / "work"), "--out", str(folder), *publish]), folder


def test_rates_and_files_are_those_of_the_runs(in_scenes: tuple[dict, Path]) -> None:
    # Who plans in scenes does both, others are filtered.
    ways = [(run["method"], run["way"]) for run in in_scenes[0]["runs"]]
    assert ways == [("fast_graspd", IN_SCENE), ("fast_graspd", FILTERED), ("autograsp", FILTERED)]
    for run in in_scenes[0]["runs"]:
        assert 0 <= run["lift_hard_count"] <= run["lift_count"] <= run["clear_count"] <= run["grasps"]
        assert run["valid_per_second"] == pytest.approx(run["lift_count"] / run["seconds"], rel=1e-4)
        assert run["lift_low"] <= run["lift"] <= run["lift_high"]
        assert run["end_seconds"] > run["seconds"] and run["lift_dexgraspbench_count"] <= run["clear_count"]
        assert run["end_to_end_per_second"] == pytest.approx(run["lift_count"] / run["end_seconds"], rel=1e-4)
        assert (run["robust"] is None) == (run["seconds_to_first"] is None) == (run["lift_count"] == 0)
        assert run["robust"] is None or 0 <= run["robust_low"] <= run["robust"] <= run["robust_high"] <= 1
    found, folder = in_scenes
    assert_written(folder, found, "method")
    assert f"| {IN_SCENE} | fast_graspd | draft |" in (folder / "chart.md").read_text()


def test_a_run_that_was_stopped_plans_only_what_is_missing(in_scenes: tuple[dict, Path], monkeypatch) -> None:
    found, folder = in_scenes
    kept = sorted((folder / "work").glob("*.json"))
    assert len(kept) == 3
    kept[0].unlink()
    planned = []
    runs = {(run["method"], run["way"]): run for run in found["runs"]}

    def tried(setting, way: str, *_: object) -> dict:
        planned.append((setting.method, way))
        return runs[setting.method, way]

    monkeypatch.setattr("benchmarks.scenes_chart.comparison._run_setting", tried)
    again = scenes_chart([*ON_TABLE, "--work", str(folder / "work")])
    assert again["runs"] == found["runs"] and len(planned) == 1


def test_a_chart_of_earlier_is_published_and_drawn(made: tuple[dict, Path], tmp_path: Path) -> None:
    found, folder = made
    graspd("chart --publish --from", folder / "chart.json", "--data-dir", tmp_path, "--out", tmp_path)
    stored = latest_record(open_store((tmp_path / "store").as_uri()), "charts")
    assert stored is not None and stored["runs"] == found["runs"]
    assert (tmp_path / "chart.json").read_bytes() == (folder / "chart.json").read_bytes()
    assert (tmp_path / "chart.md").read_text() == (folder / "chart.md").read_text()


def test_a_chart_of_scenes_is_published_apart(in_scenes: tuple[dict, Path]) -> None:
    found, folder = in_scenes
    store = open_store((folder / "data" / "store").as_uri())
    stored = latest_record(store, "scene_charts/table")
    assert stored is not None and stored["runs"] == found["runs"] and latest_record(store, "charts") is None
    # What it promises is what a job in such a scene is given.
    draft = next(run for run in found["runs"] if run["way"] == IN_SCENE)
    chosen = cheapest_fidelity(stored, f"lift>={draft['lift']}", method="fast_graspd", hand="barrett", object_="block")
    assert chosen == ("draft", "hand and object", draft["lift"])


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("{}", "is no chart.json"),
        ('{"created": "c", "runs": []}', "has no summary"),
        ('{"created": "c", "runs": [], "scene": {}}', "is a chart of scenes"),
    ],
)
def test_a_file_that_is_no_chart_is_refused_in_a_line(tmp_path: Path, content: str, words: str) -> None:
    (tmp_path / "chart.json").write_text(content)
    assert words in refused("chart --from", tmp_path / "chart.json")


def run_in_scenes(way: str, pair: str, lifted: int, seconds: float, grasps: int = 10) -> dict:
    counts = {"grasps": grasps, "seconds": seconds, "end_seconds": 2 * seconds, "robust_sum": 0.5 * lifted}
    counts |= dict.fromkeys(("clear_count", "lift_count", "lift_dexgraspbench_count"), lifted) | {"lift_hard_count": 0}
    said = {"way": way, "method": "m", "fidelity": "f", "batch": grasps, "hand": "h", "object": pair, "note": ""}
    return {**said, **counts, **lift_figures([counts]), "scenes": 1, "seconds_to_first": seconds if lifted else None}


def test_gain_is_median_of_pairs_in_which_filtering_found_any() -> None:
    runs = [run_in_scenes(IN_SCENE, pair, 8, 2.0) for pair in "abc"]
    runs += [run_in_scenes(FILTERED, pair, lifted, 1.0) for pair, lifted in (("a", 1), ("b", 2), ("c", 0))]
    inside, outside = summed_in_scenes(runs)
    assert inside["gain"] == pytest.approx((4 / 1 + 4 / 2) / 2)
    assert (inside["pairs_with_one"], outside["pairs_with_one"]) == (3, 2)
    assert inside["robust"] == 0.5 and (inside["robust_low"], inside["robust_high"]) == pytest.approx(
        wilson_interval(12, 24)
    )
    assert outside["seconds_to_first"] is None and inside["seconds_to_first"] == 2.0
    assert inside["lift"] == 0.8 and outside["valid_per_second"] == pytest.approx(1.0)


def test_a_pair_that_is_refused_counts_as_tries_without_a_lift() -> None:
    refused = run_in_scenes(IN_SCENE, "a", 0, 0.0) | {"note": "nothing can reach it"}
    (row,) = summed_in_scenes([refused, run_in_scenes(IN_SCENE, "b", 5, 1.0)])
    assert row["lift"] == 0.25 and row["grasps_per_second"] == pytest.approx(10.0)
    assert row["valid_per_second"] == pytest.approx(5.0)
    chart = {"runs": [refused], "summary": [row], "by_hand": {}, "models": 2, "versions": {"graspd": "0"}}
    said = scenes_page(chart | {"device": "d", "created": "c", "scene": {"kind": "table", "faces": "all"}})
    assert "## Refused" in said and "nothing can reach it" in said
