"""A chart as JSON, CSV, Markdown and plots."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from graspd.studies.chart.figure import SPEED, draw, draw_hands, draw_sweeps
from graspd.studies.chart.statistics import most_valid

Row = Mapping[str, Any]

#: Columns of the CSV file, one row per run.
COLUMNS: Final = (
    "method",
    "fidelity",
    "batch",
    "hand",
    "object",
    "grasps",
    "valid",
    "repeats",
    "grasps_per_second",
    "kept",
    "end_to_end_per_second",
    "end_to_end_per_second_low",
    "end_to_end_per_second_high",
    "seconds_to_first_valid",
    "valid_per_second",
    "valid_per_second_low",
    "valid_per_second_high",
    "dexgraspbench",
    "dexgraspbench_low",
    "dexgraspbench_high",
    "hard",
    "hard_low",
    "hard_high",
    "robust",
    "robust_low",
    "robust_high",
    "gsr",
    "gsr_low",
    "gsr_high",
    "epsilon",
    "epsilon_low",
    "epsilon_high",
    "pd_mm",
    "pd_mm_low",
    "pd_mm_high",
    "spd_mm",
    "ca_cm2",
    "iv_cm3",
    "wrench_volume",
)

#: Accuracies of the summary, and their formats.
ACCURACIES: Final = (("dexgraspbench", ".2f"), ("hard", ".2f"), ("robust", ".2f"), ("epsilon", ".3f"), ("pd_mm", ".2f"))


def write(chart: Row, folder: Path) -> list[Path]:
    """Write chart.{json,csv,md,png,svg}, chart.hands.png, and sweeps.png if there are sweeps, to a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "chart.json").write_text(json.dumps(chart, indent=1, allow_nan=False) + "\n")
    with (folder / "chart.csv").open("w", newline="") as stream:
        writer = csv.DictWriter(stream, COLUMNS, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(chart["runs"])
    files = [folder / name for name in ("chart.json", "chart.csv", "chart.md", "chart.png", "chart.svg")]
    draw(chart["summary"], files[3:])
    files.append(folder / "chart.hands.png")
    draw_hands(
        chart["by_hand"],
        files[-1:],
        key="dexgraspbench",
        speed=SPEED,
        words=("success under the DexGraspBench protocol", "valid grasps per second, end to end"),
    )
    if chart.get("sweeps"):
        files.append(folder / "sweeps.png")
        draw_sweeps(chart["sweeps"], files[-1])
    files[2].write_text(markdown(chart) + "\n")
    return files


def markdown(chart: Row) -> str:
    """Return the chart as a page: its settings, then one table per question."""
    parts = [_head(chart), summary_table(chart["summary"]), _ratios(chart["summary"])]
    if len(chart["by_hand"]) > 1:
        parts += ["## Each hand", "![Success under the DexGraspBench protocol over speed](chart.hands.png)"]
        parts += [f"### {hand}\n\n{summary_table(rows)}" for hand, rows in chart["by_hand"].items()]
    parts += ["## Each hand and object", runs_table(chart["runs"])]
    parts += [
        "## The best ten by epsilon",
        "Means over each pair's best ten grasps by ε (as the paper's table 2 takes them), then over objects.",
        best_table(chart["runs"]),
    ]
    if chart.get("sweeps"):
        parts += ["## What each knob costs and buys", _sweep_head(chart["sweeps"]), "![Knobs](sweeps.png)"]
        parts += [sweeps_table(chart["sweeps"])]
    return "\n\n".join(part for part in parts if part)


def _head(chart: Row) -> str:
    hands, objects = (", ".join(dict.fromkeys(r[name] for r in chart["runs"])) for name in ("hand", "object"))
    command = f"    {chart['command']}\n\n" if chart.get("command") else ""
    return (
        f"# Speed against accuracy\n\n{command}{chart['device']}, {chart['threads']} threads, graspd "
        f"{chart['versions']['graspd']}, Warp {chart['versions']['warp']}, {chart['created']}. Hands: {hands}. "
        f"Objects: {objects}. Warm, repeats in turn.{' ' + chart['remark'] if chart.get('remark') else ''}\n\n"
        f"- *valid*: holds in MuJoCo (DexGraspBench protocol, level *{chart['validation']['level']}*) and is feasible\n"
        "- speeds are end to end, as a job works: planned, validated, and measured where it holds; *planner's*: grasps "
        "that hold over the seconds of planner and postures alone; on a CPU a second is one of one core\n"
        "- *dexgraspbench*: holds under the unmodified protocol; *hard*: at half the friction; *robust*: share of "
        f"{chart['models']} models around the nominal one in which a grasp that holds does, on average\n"
        f"- ε, contact: μ = {chart['friction']:g}, within {1e3 * chart['threshold_m']:g} mm; ε and penetration are "
        "medians of a pair's grasps, then means over the pairs\n"
        "- bars and ±: 95 % (Wilson for shares, else bootstrap); hollow: none is valid, the most that there can be; "
        "bold: nobody faster is better\n\n"
        "![Speed against accuracy](chart.png)"
    )


def summary_table(rows: Sequence[Row]) -> str:
    """Return a row per method and fidelity, the fastest first; bold: on the Pareto front."""
    lines = [
        "| method | fidelity | batch | valid/s | first valid s | planner's/s | dexgraspbench | hard | robust | ε | "
        "penetration mm | grasps |",
        "| --- | --- | --: | --: | --: | --: | --: | --: | --: | --: | --: | --: |",
    ]
    for row in sorted(rows, key=lambda r: -r[SPEED]):
        cells = [row["method"], row["fidelity"], row["batch"], _with_bar(row, SPEED, ".3g")]
        cells += [first(row["seconds_to_first_valid"]), f"{row['valid_per_second']:.3g}"]
        for key, form in ACCURACIES:
            text = _with_bar(row, key, form)
            cells.append(f"**{text}**" if key in row["front"] else text)
        lines.append("| " + " | ".join(map(str, [*cells, row["grasps"]])) + " |")
    return "\n".join(lines)


def _with_bar(row: Row, key: str, form: str) -> str:
    if row[key] is None:
        return "–"
    half = (row[f"{key}_high"] - row[f"{key}_low"]) / 2
    return f"{row[key]:{form}} ± {half:.1g}" if form == ".3g" else f"{row[key]:{form}} ± {half:{form}}"


def share(value: float | None) -> str:
    """Return a share, or a dash if there is none."""
    return "–" if value is None else f"{value:.2f}"


def first(value: float | None) -> str:
    """Return seconds to the first, or a dash if there was none."""
    return "–" if value is None else f"{value:.2g}"


def _ratios(rows: Sequence[Row]) -> str:
    """Return the speed-up of `fast_graspd`'s default in valid grasps per second over each other method."""
    own = [r for r in rows if (r["method"], r["fidelity"]) == ("fast_graspd", "standard")]
    others = [r for r in rows if r["method"] != "fast_graspd"]
    if not own or not others:
        return ""
    best = max(own, key=lambda r: r[SPEED])
    lines = [
        "fast_graspd at its default (standard) against each other method, same run:",
        "",
        "| against | valid/s | dexgraspbench | ε | penetration mm |",
        "| --- | --: | --: | --: | --: |",
    ]
    for row in others:
        times = f"× {best[SPEED] / row[SPEED]:.3g}" if row[SPEED] else ""
        if not times:
            times = f"> × {best[SPEED] / most_valid(row):.3g} (0 of {row['grasps']} valid)"
        lines.append(
            f"| {row['method']} {row['fidelity']} | {times} | {best['dexgraspbench'] - row['dexgraspbench']:+.2f} "
            f"| {best['epsilon'] - row['epsilon']:+.3f} | {best['pd_mm'] - row['pd_mm']:+.2f} |"
        )
    return "\n".join(lines)


def runs_table(runs: Sequence[Row]) -> str:
    """Return a row per run."""
    lines = [
        "| hand | object | method | fidelity | valid/s | dexgraspbench | hard | robust | ε | penetration mm | "
        "self mm | contact cm² |",
        "| --- | --- | --- | --- | --: | --: | --: | --: | --: | --: | --: | --: |",
    ]
    lines += [
        f"| {run['hand']} | {run['object']} | {run['method']} | {run['fidelity']} | {run[SPEED]:.3g} "
        f"| {run['dexgraspbench']:.2f} | {run['hard']:.2f} | {share(run['robust'])} | {run['epsilon']:.3f} | "
        f"{run['pd_mm']:.2f} | {run['spd_mm']:.2f} | {run['ca_cm2']:.1f} |"
        for run in sorted(runs, key=lambda r: (r["hand"], r["object"]))
    ]
    return "\n".join(lines)


def best_table(runs: Sequence[Row]) -> str:
    """Return the paper's table 2: contact area, intersection volume, ε, wrench volume, displacement."""
    groups: dict[tuple[str, str, str], list[Row]] = {}
    for run in runs:
        groups.setdefault((run["hand"], run["method"], run["fidelity"]), []).append(run["best"])
    lines = [
        "| hand | method | fidelity | CA cm² ↑ | IV cm³ ↓ | ε ↑ | Vol ↑ | SD cm ↓ |",
        "| --- | --- | --- | --: | --: | --: | --: | --: |",
    ]
    for (hand, method, fidelity), rows in sorted(groups.items()):
        mean = {
            key: _mean([row[key] for row in rows]) for key in ("ca_cm2", "iv_cm3", "epsilon", "wrench_volume", "sd_cm")
        }
        lines.append(
            f"| {hand} | {method} | {fidelity} | {mean['ca_cm2']:.1f} | {mean['iv_cm3']:.2f} | {mean['epsilon']:.3f} "
            f"| {mean['wrench_volume']:.2f} | {mean['sd_cm']:.2f} |"
        )
    return "\n".join(lines)


def _sweep_head(sweeps: Sequence[Row]) -> str:
    first = sweeps[0]
    return (
        f"{first['hand']} on {first['object']}, {first['grasps']} grasps a value, standard with one knob turned; "
        "speed is against the default."
    )


def _mean(values: Sequence[float | None]) -> float:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else float("nan")


def sweeps_table(sweeps: Sequence[Row]) -> str:
    """Return a row per knob value: gain in speed and loss in accuracy against the default's row."""
    lines = [
        "| knob | value | s/grasp | speed | GSR | ε | penetration mm |",
        "| --- | --- | --: | --: | --: | --: | --: |",
    ]
    lines += [
        f"| {row['knob']} | {row['value']}{' (default)' if row['default'] else ''} "
        f"| {1.0 / row['grasps_per_second']:.3g} | × {row['speedup']:.2f} | {_with_bar(row, 'gsr', '.2f')} "
        f"| {_with_bar(row, 'epsilon', '.3f')} | {_with_bar(row, 'pd_mm', '.2f')} |"
        for row in sweeps
    ]
    return "\n".join(lines)
