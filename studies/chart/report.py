"""A chart of free objects or of scenes, as JSON, CSV, Markdown and plots."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from graspd.service.model.studies import FILTERED, IN_SCENE, IN_SCENES
from graspd.studies.chart.figure import SPEED, draw, draw_hands, draw_scenes, fidelity_label
from graspd.studies.chart.statistics import valid_rate_bound
from graspd.studies.figures import markdown_table

Row = Mapping[str, Any]


def _names_with_bounds(*names: str) -> tuple[str, ...]:
    return tuple(f"{name}{end}" for name in names for end in ("", "_low", "_high"))


#: Columns of the CSV file, one row per run.
COLUMNS: Final = (
    *("method", "fidelity", "batch", "hand", "object", "grasps", "valid", "repeats", "grasps_per_second", "kept"),
    *_names_with_bounds("end_to_end_per_second"),
    "seconds_to_first_valid",
    *_names_with_bounds("valid_per_second", "dexgraspbench", "hard", "robust", "gsr", "epsilon", "pd_mm"),
    *("spd_mm", "ca_cm2", "iv_cm3", "wrench_volume"),
)
SCENE_COLUMNS: Final = (
    *("way", "method", "fidelity", "hand", "object", "scenes", "grasps", "seconds", "end_seconds"),
    *("clear_count", "lift_count", "lift_dexgraspbench_count", "lift_hard_count", "clear"),
    *_names_with_bounds("lift", "lift_dexgraspbench", "lift_hard", "robust"),
    "grasps_per_second",
    *_names_with_bounds("valid_per_second", "end_to_end_per_second"),
    *("seconds_to_first", "note"),
)

#: First columns of tables of scenes, with their number formats.
_MODE_COLUMNS: Final = {"way": "", "method": "", "fidelity": "", "grasps": "", "clear": ".2f"}
#: Accuracies of the summary with their number formats.
ACCURACIES: Final = (("dexgraspbench", ".2f"), ("hard", ".2f"), ("robust", ".2f"), ("epsilon", ".3f"), ("pd_mm", ".2f"))


def write(chart: Row, folder: Path) -> None:
    """Write chart.{json,csv,md,png,svg} and chart.hands.png."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "chart.json").write_text(json.dumps(chart, indent=1, allow_nan=False) + "\n")
    with (folder / "chart.csv").open("w", newline="") as stream:
        columns = SCENE_COLUMNS if "scene" in chart else COLUMNS
        writer = csv.DictWriter(stream, columns, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(chart["runs"])
    pictures, by_hand = [folder / "chart.png", folder / "chart.svg"], folder / "chart.hands.png"
    if "scene" in chart:
        draw_scenes([with_mode_name(row) for row in chart["summary"]], pictures, second=time_unit(chart))
        hands = {hand: [with_mode_name(row) for row in rows] for hand, rows in chart["by_hand"].items()}
        words = ("lifted share of all candidates", f"lifted grasps per {time_unit(chart)}, end to end")
        draw_hands(hands, by_hand, key="lift", words=words, label=fidelity_label)
    else:
        draw(chart["summary"], pictures)
        words = ("success under the DexGraspBench protocol", "valid grasps per second, end to end")
        draw_hands(chart["by_hand"], by_hand, key="dexgraspbench", words=words)
    (folder / "chart.md").write_text(markdown(chart) + "\n")


def markdown(chart: Row) -> str:
    """Return the chart as a page in Markdown."""
    if "scene" in chart:
        return _scene_page(chart)
    parts = [_head(chart), summary_table(chart["summary"]), _ratios(chart["summary"])]
    if len(chart["by_hand"]) > 1:
        parts += ["## Each hand", "![Success under the DexGraspBench protocol over speed](chart.hands.png)"]
        parts += [f"### {hand}\n\n{summary_table(rows)}" for hand, rows in chart["by_hand"].items()]
    parts += ["## Each hand and object", runs_table(chart["runs"])]
    parts += [
        "## The best ten by epsilon",
        "Means over each pair's best ten grasps by ε, as in table 2 of the Fast-Grasp'D paper, then over objects.",
        best_table(chart["runs"]),
    ]
    return "\n\n".join(part for part in parts if part)


def _settings(chart: Row) -> tuple[str, str, str, str]:
    """Return command, hands, objects and remark of a chart as texts for its head."""
    hands, objects = (", ".join(dict.fromkeys(run[name] for run in chart["runs"])) for name in ("hand", "object"))
    command = f"    {chart['command']}\n\n" if chart.get("command") else ""
    return command, hands, objects, f" {chart['remark']}" if chart.get("remark") else ""


def _head(chart: Row) -> str:
    command, hands, objects, remark = _settings(chart)
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
        cells += [_format(row["seconds_to_first_valid"], ".2g"), f"{row['valid_per_second']:.3g}"]
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


def _format(value: Any, form: str = ".2f") -> str:
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
    return markdown_table(headings, (_cells(run, columns) for run in ordered), left=4)


def _cells(row: Row, columns: Mapping[str, str]) -> list[str]:
    """Return values of a row as texts; `columns` has their number formats, empty for names and counts."""
    return [_format(row[key], form) for key, form in columns.items()]


def best_table(runs: Sequence[Row]) -> str:
    """Return means as in the paper's table 2: contact area, intersection, ε, wrench volume, displacement."""
    groups: dict[tuple[str, str, str], list[Row]] = {}
    for run in runs:
        groups.setdefault((run["hand"], run["method"], run["fidelity"]), []).append(run["best"])
    columns = {"ca_cm2": ".1f", "iv_cm3": ".2f", "epsilon": ".3f", "wrench_volume": ".2f", "sd_cm": ".2f"}
    found = [
        [*names, *(f"{_mean(rows, key):{form}}" for key, form in columns.items())]
        for names, rows in sorted(groups.items())
    ]
    return markdown_table("hand | method | fidelity | CA cm² ↑ | IV cm³ ↓ | ε ↑ | Vol ↑ | SD cm ↓", found, left=3)


def _mean(rows: Sequence[Row], key: str) -> float:
    known: list[float] = [row[key] for row in rows if row[key] is not None]
    return sum(known) / len(known) if known else float("nan")


def time_unit(chart: Row) -> str:
    """Return the unit of time of the chart: core-seconds on a CPU, wall-clock seconds on a GPU."""
    return "CPU second" if str(chart["device"]).startswith("cpu") else "second"


def with_mode_name(row: Row) -> dict[str, Any]:
    """Return the row with its planning mode in the method's name, as in the plot."""
    return {**row, "method": f"{row['method']}, {row['way']}"}


def _scene_page(chart: Row) -> str:
    parts = [
        _scene_head(chart),
        "![Speed against lifts](chart.png)",
        _scene_summary_table(chart["summary"], time_unit(chart)),
    ]
    if len(chart["by_hand"]) > 1:
        parts += ["## Each hand", "![Lifted over speed](chart.hands.png)"]
        parts += [
            f"### {hand}\n\n{_scene_summary_table(rows, time_unit(chart))}" for hand, rows in chart["by_hand"].items()
        ]
    parts += ["## Each hand and object", _scene_runs_table(chart["runs"], time_unit(chart))]
    if refused := [run for run in chart["runs"] if run["note"]]:
        lines = [f"- {r['method']} {r['fidelity']}, {r['hand']}, {r['object']}: {r['note']}" for r in refused]
        parts += ["## Refused", "\n".join(lines)]
    return "\n\n".join(parts)


def _scene_head(chart: Row) -> str:
    command, hands, objects, remark = _settings(chart)
    seconds = "core-seconds of the CPU" if time_unit(chart) == "CPU second" else "wall-clock seconds"
    return (
        f"# Grasps planned in scenes, compared with filtered free grasps\n\n{command}{chart['device']}, graspd "
        f"{chart['versions']['graspd']}, {chart['created']}. Scene: {chart['scene']['kind']}, faces "
        f"{chart['scene']['faces']}. Hands: {hands}. Objects: {objects}.{remark}\n\n"
        f"- *{IN_SCENE}*: planned for the scene\n"
        f"- *{FILTERED}*: planned around a free object and placed into the same scenes in turn; baselines have "
        "only this mode\n"
        "- *clear*: no contact with supports or neighbours on the approach, while closing and on the lift\n"
        "- *lifted*: clear, and lifted by MuJoCo (level *lift*); *dexgraspbench*: lifted in DexGraspBench's test; "
        "*half friction*: also lifted at half friction; all are shares of all candidates\n"
        f"- *robust*: mean share of {chart['models']} perturbed models in which a lifted grasp is also lifted\n"
        f"- *lifted per second*: time includes planner, postures, trajectory, lift, and metrics of lifted grasps, in "
        f"{seconds}; *planner only*: planner and postures\n"
        "- bars: 95 % (Wilson); hollow marker: no lifted grasp, upper bound of the speed"
    )


def _scene_summary_table(rows: Sequence[Row], second: str) -> str:
    headings = (
        "mode | method | fidelity | candidates | clear | lifted | dexgraspbench | half friction | robust | "
        f"lifted per {second} | planner only | {second}s to the first lift | pairs with a lift | × filtered"
    )
    found = []
    for row in rows:
        speeds = _cells(row, {SPEED: ".3g", "valid_per_second": ".3g", "seconds_to_first": ".2g"})
        pairs = f"{row['pairs_with_one']} of {row['pairs']}"
        lifts = [_bold(row, key) for key in IN_SCENES]
        found.append([*_cells(row, _MODE_COLUMNS), *lifts, *speeds, pairs, _format(row["gain"], ".3g")])
    note = (
        "× filtered: median ratio of planner-only speeds, in the scene to filtered, over pairs with lifted filtered "
        "grasps. Bold: no faster setting is better."
    )
    return f"{markdown_table(headings, found, left=3)}\n\n{note}"


def _bold(row: Row, key: str) -> str:
    return f"**{_format(row[key])}**" if key in row["front"] else _format(row[key])


def _scene_runs_table(runs: Sequence[Row], second: str) -> str:
    headings = (
        "hand | object | mode | method | fidelity | candidates | clear | lifted | dexgraspbench | half friction | "
        f"robust | lifted per {second}"
    )
    columns = {"hand": "", "object": "", **_MODE_COLUMNS, **dict.fromkeys(IN_SCENES, ".2f"), SPEED: ".3g"}
    return markdown_table(headings, (_cells(run, columns) for run in runs), left=5)
