"""A chart of scenes as JSON, CSV, Markdown and plots."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from graspd.service.model.studies import FILTERED, IN_SCENE, IN_SCENES
from graspd.studies.chart.figure import SPEED, Row, Rows, draw_hands, draw_over_speed, draw_panel, method_styles, save
from graspd.studies.chart.report import cells_text, format_value, names_with_bounds, settings_text, write_csv
from graspd.studies.figures import markdown_table, new_figure

COLUMNS: Final = (
    *("way", "method", "fidelity", "hand", "object", "scenes", "grasps", "seconds", "end_seconds"),
    *("clear_count", "lift_count", "lift_dexgraspbench_count", "lift_hard_count", "clear"),
    *names_with_bounds("lift", "lift_dexgraspbench", "lift_hard", "robust"),
    "grasps_per_second",
    *names_with_bounds("valid_per_second", "end_to_end_per_second"),
    *("seconds_to_first", "note"),
)
#: First columns of tables, with their number formats.
_MODE_COLUMNS: Final = {"way": "", "method": "", "fidelity": "", "grasps": "", "clear": ".2f"}
#: Title and key of each accuracy.
PANELS: Final = (
    ("Lifted, share of all candidates", "lift"),
    ("Lifted under the DexGraspBench protocol", "lift_dexgraspbench"),
    ("Lifted at half the friction", "lift_hard"),
    ("Robust share of lifted grasps", "robust"),
)


def write(chart: Row, folder: Path) -> None:
    """Write chart.{json,csv,md,png,svg} and chart.hands.png."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "chart.json").write_text(json.dumps(chart, indent=1, allow_nan=False) + "\n")
    write_csv(chart["runs"], COLUMNS, folder / "chart.csv")
    rows = [_with_mode_name(row) for row in chart["summary"]]
    _draw(rows, [folder / "chart.png", folder / "chart.svg"], second=_time_unit(chart))
    hands = {hand: [_with_mode_name(row) for row in rows] for hand, rows in chart["by_hand"].items()}
    words = ("lifted share of all candidates", f"lifted grasps per {_time_unit(chart)}, end to end")
    draw_hands(hands, folder / "chart.hands.png", key="lift", words=words, label=_fidelity_label)
    (folder / "chart.md").write_text(markdown(chart) + "\n")


def _draw(rows: Rows, files: Sequence[Path], *, second: str) -> None:
    """Plot shares of candidates over speed, and over time to the first lifted grasp.
    Speed is in lifted grasps per `second`, the unit of time."""
    figure = new_figure(15.5, 8.6)
    panels = figure.subplots(2, 3)
    styles = method_styles(rows)
    words = f"lifted grasps per {second}, end to end"
    labels = []
    for axes, (title, key) in zip(panels.flat[:4], PANELS, strict=True):
        labels += draw_over_speed(axes, rows, styles, key, title, words, _fidelity_label)
    timed = [row for row in rows if row["seconds_to_first"]]
    last = panels.flat[4]
    labels += draw_panel(last, timed, styles, x="seconds_to_first", y="lift", label=_fidelity_label)
    last.set(xlabel=f"{second}s to the first that is lifted (less is better)", ylim=(-0.07, 1.07))
    last.set_title("Lifted, by settings with a lift in every pair", loc="left", fontsize=11)
    panels.flat[5].set_visible(False)
    figure.legend(*panels.flat[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    save(figure, labels, files)


def _fidelity_label(row: Row, rows: Rows) -> str:
    """Return the fidelity if the method has several, else no text, because the legend has its name."""
    return str(row["fidelity"]) if sum(r["method"] == row["method"] for r in rows) > 1 else ""


def _time_unit(chart: Row) -> str:
    """Return the unit of time of the chart: core-seconds on a CPU, wall-clock seconds on a GPU."""
    return "CPU second" if str(chart["device"]).startswith("cpu") else "second"


def _with_mode_name(row: Row) -> dict[str, Any]:
    """Return the row with its planning mode in the method's name, as in the plot."""
    return {**row, "method": f"{row['method']}, {row['way']}"}


def markdown(chart: Row) -> str:
    """Return the chart as a page in Markdown."""
    parts = [_head(chart), "![Speed against lifts](chart.png)", _summary_table(chart["summary"], _time_unit(chart))]
    if len(chart["by_hand"]) > 1:
        parts += ["## Each hand", "![Lifted over speed](chart.hands.png)"]
        parts += [f"### {hand}\n\n{_summary_table(rows, _time_unit(chart))}" for hand, rows in chart["by_hand"].items()]
    parts += ["## Each hand and object", _runs_table(chart["runs"], _time_unit(chart))]
    if refused := [run for run in chart["runs"] if run["note"]]:
        lines = [f"- {r['method']} {r['fidelity']}, {r['hand']}, {r['object']}: {r['note']}" for r in refused]
        parts += ["## Refused", "\n".join(lines)]
    return "\n\n".join(parts)


def _head(chart: Row) -> str:
    command, hands, objects, remark = settings_text(chart)
    seconds = "core-seconds of the CPU" if _time_unit(chart) == "CPU second" else "wall-clock seconds"
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


def _summary_table(rows: Sequence[Row], second: str) -> str:
    headings = (
        "mode | method | fidelity | candidates | clear | lifted | dexgraspbench | half friction | robust | "
        f"lifted per {second} | planner only | {second}s to the first lift | pairs with a lift | × filtered"
    )
    found = []
    for row in rows:
        speeds = cells_text(row, {SPEED: ".3g", "valid_per_second": ".3g", "seconds_to_first": ".2g"})
        pairs = f"{row['pairs_with_one']} of {row['pairs']}"
        lifts = [_bold(row, key) for key in IN_SCENES]
        found.append([*cells_text(row, _MODE_COLUMNS), *lifts, *speeds, pairs, format_value(row["gain"], ".3g")])
    note = (
        "× filtered: median ratio of planner-only speeds, in the scene to filtered, over pairs with lifted filtered "
        "grasps. Bold: no faster setting is better."
    )
    return f"{markdown_table(headings, found, left=3)}\n\n{note}"


def _bold(row: Row, key: str) -> str:
    return f"**{format_value(row[key])}**" if key in row["front"] else format_value(row[key])


def _runs_table(runs: Sequence[Row], second: str) -> str:
    headings = (
        "hand | object | mode | method | fidelity | candidates | clear | lifted | dexgraspbench | half friction | "
        f"robust | lifted per {second}"
    )
    columns = {"hand": "", "object": "", **_MODE_COLUMNS, **dict.fromkeys(IN_SCENES, ".2f"), SPEED: ".3g"}
    return markdown_table(headings, (cells_text(run, columns) for run in runs), left=5)
