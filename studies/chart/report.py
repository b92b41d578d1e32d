"""A chart as JSON, CSV, Markdown and plots."""

import csv
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from graspd.studies.chart.figure import SPEED, draw, draw_hands
from graspd.studies.chart.statistics import valid_rate_bound
from graspd.studies.figures import markdown_table

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
#: Accuracies of the summary with their number formats.
ACCURACIES: Final = (("dexgraspbench", ".2f"), ("hard", ".2f"), ("robust", ".2f"), ("epsilon", ".3f"), ("pd_mm", ".2f"))


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
    parts = [_head(chart), summary_table(chart["summary"]), _ratios(chart["summary"])]
    if len(chart["by_hand"]) > 1:
        parts += ["## Each hand", "![Success under the DexGraspBench protocol over speed](chart.hands.png)"]
        parts += [f"### {hand}\n\n{summary_table(rows)}" for hand, rows in chart["by_hand"].items()]
    parts += ["## Each hand and object", runs_table(chart["runs"])]
    groups: dict[tuple[str, str, str], list[Row]] = {}
    for run in chart["runs"]:
        groups.setdefault((run["hand"], run["method"], run["fidelity"]), []).append(run["best"])
    columns = {"ca_cm2": ".1f", "iv_cm3": ".2f", "epsilon": ".3f", "wrench_volume": ".2f", "sd_cm": ".2f"}
    found = [
        [*names, *(f"{_mean(rows, key):{form}}" for key, form in columns.items())]
        for names, rows in sorted(groups.items())
    ]
    parts += [
        "## The best ten by epsilon",
        "Means over each pair's best ten grasps by ε, as in table 2 of the Fast-Grasp'D paper, then over objects.",
        markdown_table("hand | method | fidelity | CA cm² ↑ | IV cm³ ↓ | ε ↑ | Vol ↑ | SD cm ↓", found, left=3),
    ]
    return "\n\n".join(part for part in parts if part)


def settings_text(chart: Row) -> tuple[str, str, str, str]:
    """Return command, hands, objects and remark of a chart as texts for its head."""
    hands, objects = (", ".join(dict.fromkeys(run[name] for run in chart["runs"])) for name in ("hand", "object"))
    command = f"    {chart['command']}\n\n" if chart.get("command") else ""
    return command, hands, objects, f" {chart['remark']}" if chart.get("remark") else ""


def _head(chart: Row) -> str:
    command, hands, objects, remark = settings_text(chart)
    return (
        f"# Speed against accuracy\n\n{command}{chart['device']}, {chart['threads']} threads, graspd "
        f"{chart['versions']['graspd']}, Warp {chart['versions']['warp']}, {chart['created']}. Hands: {hands}. "
        f"Objects: {objects}. Settings are warmed up; their repeats are interleaved.{remark}\n\n"
        f"- *valid*: held in MuJoCo (DexGraspBench protocol, level *{chart['validation']['level']}*) and feasible\n"
        "- *valid/s* and *first valid s*: time includes planning, validation, and metrics of held grasps; on a CPU a "
        "second is one core-second\n"
        "- *held/s, planner only*: held grasps per second of planner and postures\n"
        "- *dexgraspbench*: share held under the unmodified protocol; *hard*: at half friction, level *standard*\n"
        f"- *robust*: mean share of {chart['models']} perturbed models in which a held grasp also holds\n"
        f"- ε and contact area: μ = {chart['friction']:g}, within {1e3 * chart['threshold_m']:g} mm; ε and penetration "
        "are medians of a pair's grasps, then means over the pairs\n"
        "- bars and ±: 95 % (Wilson for shares, else bootstrap); hollow marker: no valid grasp, upper bound of the "
        "speed; bold: no faster setting is better\n\n"
        "![Speed against accuracy](chart.png)"
    )


def summary_table(rows: Sequence[Row]) -> str:
    """Return a row per method and fidelity, the fastest first; bold if on the Pareto front."""
    headings = (
        "method | fidelity | batch | valid/s | first valid s | held/s, planner only | dexgraspbench | hard | robust | "
        "ε | penetration mm | grasps"
    )
    found = []
    for row in sorted(rows, key=lambda r: -r[SPEED]):
        cells = [row["method"], row["fidelity"], row["batch"], value_with_error(row, SPEED, ".3g")]
        cells += [format_value(row["seconds_to_first_valid"], ".2g"), f"{row['valid_per_second']:.3g}"]
        for key, form in ACCURACIES:
            text = value_with_error(row, key, form)
            cells.append(f"**{text}**" if key in row["front"] else text)
        found.append([*cells, row["grasps"]])
    return markdown_table(headings, found, left=2)


def value_with_error(row: Row, key: str, form: str) -> str:
    if row[key] is None:
        return "–"
    half = (row[f"{key}_high"] - row[f"{key}_low"]) / 2
    return f"{row[key]:{form}} ± {half:.1g}" if form == ".3g" else f"{row[key]:{form}} ± {half:{form}}"


def format_value(value: Any, form: str = ".2f") -> str:
    return "–" if value is None else f"{value:{form}}"


def _ratios(rows: Sequence[Row]) -> str:
    """Return the speed-up of `fast_graspd`'s default over each other method, in valid grasps per second."""
    own = [r for r in rows if (r["method"], r["fidelity"]) == ("fast_graspd", "standard")]
    others = [r for r in rows if r["method"] != "fast_graspd"]
    if not own or not others:
        return ""
    best = max(own, key=lambda r: r[SPEED])
    found = []
    for row in others:
        if row[SPEED]:
            times = f"× {best[SPEED] / row[SPEED]:.3g}"
        else:
            times = f"> × {best[SPEED] / valid_rate_bound(row):.3g} (0 of {row['grasps']} valid)"
        forms = {"dexgraspbench": "+.2f", "epsilon": "+.3f", "pd_mm": "+.2f"}
        gains = [f"{best[key] - row[key]:{form}}" for key, form in forms.items()]
        found.append([f"{row['method']} {row['fidelity']}", times, *gains])
    head = "fast_graspd at its default fidelity (*standard*), relative to each other method in the same run:"
    return f"{head}\n\n{markdown_table('relative to | valid/s | dexgraspbench | ε | penetration mm', found)}"


def runs_table(runs: Sequence[Row]) -> str:
    """Return a row per run, by hand and object."""
    headings = (
        "hand | object | method | fidelity | valid/s | dexgraspbench | hard | robust | ε | penetration mm | self mm | "
        "contact cm²"
    )
    columns = {"hand": "", "object": "", "method": "", "fidelity": "", SPEED: ".3g", **dict(ACCURACIES)}
    columns |= {"spd_mm": ".2f", "ca_cm2": ".1f"}
    ordered = sorted(runs, key=lambda run: (run["hand"], run["object"]))
    return markdown_table(headings, (cells_text(run, columns) for run in ordered), left=4)


def cells_text(row: Row, columns: Mapping[str, str]) -> list[str]:
    """Return values of a row as texts; `columns` has their number formats, empty for names and counts."""
    return [format_value(row[key], form) for key, form in columns.items()]


def _mean(rows: Sequence[Row], key: str) -> float:
    known: list[float] = [row[key] for row in rows if row[key] is not None]
    return sum(known) / len(known) if known else float("nan")
