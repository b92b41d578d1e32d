"""A chart as JSON, CSV, Markdown and plots."""

import csv
import json
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from graspd.studies.chart.figure import SPEED, draw, draw_hands
from graspd.studies.chart.statistics import valid_rate_bound
from graspd.studies.figures import TEMPLATES

Row = Mapping[str, Any]


def names_with_bounds(*names: str) -> tuple[str, ...]:
    return tuple(f"{name}{end}" for name in names for end in ("", "_low", "_high"))


#: Columns of the CSV file, one row per run.
COLUMNS: Final = (
    *("method", "fidelity", "batch", "hand", "object", "grasps", "valid", "repeats", "grasps_per_second", "kept"),
    *names_with_bounds("end_to_end_per_second"),
    "seconds_to_first_valid",
    *names_with_bounds("valid_per_second", "dexgraspbench", "hard", "robust", "gsr", "epsilon", "pd_mm"),
    *("spd_mm", "ca_cm2", "iv_cm3", "wrench_volume"),
)


def write(chart: Row, folder: Path) -> None:
    """Write chart.{json,csv,md,png,svg} and chart.hands.png."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "chart.json").write_text(json.dumps(chart, indent=1, allow_nan=False) + "\n")
    write_csv(chart["runs"], COLUMNS, folder / "chart.csv")
    draw(chart["summary"], [folder / "chart.png", folder / "chart.svg"])
    words = ("success under the DexGraspBench protocol", "valid grasps per second, end to end")
    draw_hands(chart["by_hand"], folder / "chart.hands.png", key="dexgraspbench", words=words)
    (folder / "chart.md").write_text(markdown(chart) + "\n")


def write_csv(runs: Sequence[Row], columns: Sequence[str], file: Path) -> None:
    with file.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, columns, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(runs)


def markdown(chart: Row) -> str:
    """Return the chart as a page in Markdown."""
    command, hands, objects, note = settings_text(chart)
    best = defaultdict(list)
    for run in chart["runs"]:
        best[run["hand"], run["method"], run["fidelity"]].append(run["best"])
    head = {"command_line": command, "hands": hands, "objects": objects, "note": note}
    return _TEMPLATE.render(chart, **head, best_ten=sorted(best.items()), speed=SPEED).rstrip("\n")


def settings_text(chart: Row) -> tuple[str, str, str, str]:
    """Return command, hands, objects and remark of a chart as texts for its head."""
    hands, objects = (", ".join(dict.fromkeys(run[name] for run in chart["runs"])) for name in ("hand", "object"))
    command = f"    {chart['command']}\n\n" if chart.get("command") else ""
    return command, hands, objects, f" {chart['remark']}" if chart.get("remark") else ""


def value_with_error(row: Row, key: str, form: str) -> str:
    if row[key] is None:
        return "–"
    half = (row[f"{key}_high"] - row[f"{key}_low"]) / 2
    return f"{row[key]:{form}} ± {half:.1g}" if form == ".3g" else f"{row[key]:{form}} ± {half:{form}}"


def format_value(value: Any, form: str = ".2f") -> str:
    return "–" if value is None else f"{value:{form}}"


def cells_text(row: Row, columns: Mapping[str, str]) -> list[str]:
    """Return values of a row as texts; `columns` has their number formats, empty for names and counts."""
    return [format_value(row[key], form) for key, form in columns.items()]


def _mean(rows: Sequence[Row], key: str) -> float:
    known: list[float] = [row[key] for row in rows if row[key] is not None]
    return sum(known) / len(known) if known else float("nan")


TEMPLATES.filters |= {"mean": _mean, "number": format_value, "with_error": value_with_error}
_TEMPLATE: Final = TEMPLATES.get_template("chart/page.md.j2", globals={"valid_rate_bound": valid_rate_bound})
