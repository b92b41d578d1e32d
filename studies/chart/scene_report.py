"""A chart of scenes as JSON, CSV, Markdown and plots."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from graspd.service.model.studies import FILTERED, IN_SCENE
from graspd.studies.chart.figure import SPEED, draw_hands, draw_scenes, one_of_several
from graspd.studies.chart.report import first, share
from graspd.studies.chart.scenes import ACCURACIES

Row = Mapping[str, Any]

COLUMNS: Final = (
    "way",
    "method",
    "fidelity",
    "hand",
    "object",
    "scenes",
    "grasps",
    "seconds",
    "end_seconds",
    "clear_count",
    "lift_count",
    "lift_dexgraspbench_count",
    "lift_hard_count",
    "clear",
    "lift",
    "lift_low",
    "lift_high",
    "lift_dexgraspbench",
    "lift_dexgraspbench_low",
    "lift_dexgraspbench_high",
    "lift_hard",
    "lift_hard_low",
    "lift_hard_high",
    "robust",
    "robust_low",
    "robust_high",
    "grasps_per_second",
    "valid_per_second",
    "valid_per_second_low",
    "valid_per_second_high",
    "end_to_end_per_second",
    "end_to_end_per_second_low",
    "end_to_end_per_second_high",
    "seconds_to_first",
    "note",
)


def write(chart: Row, folder: Path) -> list[Path]:
    """Write chart.json, chart.csv, chart.md, chart.png, chart.svg and chart.hands.png to a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / name for name in ("chart.json", "chart.csv", "chart.md", "chart.png", "chart.svg")]
    files[0].write_text(json.dumps(chart, indent=1, allow_nan=False) + "\n")
    with files[1].open("w", newline="") as stream:
        writer = csv.DictWriter(stream, COLUMNS, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(chart["runs"])
    draw_scenes([named(row) for row in chart["summary"]], files[3:], second=second_of(chart))
    files.append(folder / "chart.hands.png")
    by_hand = {hand: [named(row) for row in rows] for hand, rows in chart["by_hand"].items()}
    words = ("share of all candidates that is lifted", f"lifted grasps per {second_of(chart)}, end to end")
    draw_hands(by_hand, files[-1:], key="lift", speed=SPEED, words=words, label=one_of_several)
    files[2].write_text(markdown(chart) + "\n")
    return files


def second_of(chart: Row) -> str:
    """Return the name of its second: core-seconds on a CPU, wall-clock seconds on a GPU."""
    return "CPU second" if str(chart["device"]).startswith("cpu") else "second"


def named(row: Row) -> dict[str, Any]:
    """Return the row with its planning mode in the method's name, as in the plot."""
    return {**row, "method": f"{row['method']}, {row['way']}"}


def markdown(chart: Row) -> str:
    """Return the page: settings, all pairs together, each pair."""
    parts = [_head(chart), "![Speed against lifts](chart.png)", _summary(chart["summary"], second_of(chart))]
    if len(chart["by_hand"]) > 1:
        parts += ["## Each hand", "![Lifted over speed](chart.hands.png)"]
        parts += [f"### {hand}\n\n{_summary(rows, second_of(chart))}" for hand, rows in chart["by_hand"].items()]
    parts += ["## Each hand and object", _runs(chart["runs"], second_of(chart))]
    if refused := [run for run in chart["runs"] if run["note"]]:
        lines = [
            f"- {run['method']} {run['fidelity']}, {run['hand']}, {run['object']}: {run['note']}" for run in refused
        ]
        parts += ["## Refused", "\n".join(lines)]
    return "\n\n".join(parts)


def _head(chart: Row) -> str:
    hands, objects = (", ".join(dict.fromkeys(run[name] for run in chart["runs"])) for name in ("hand", "object"))
    command = f"    {chart['command']}\n\n" if chart.get("command") else ""
    remark = f" {chart['remark']}" if chart.get("remark") else ""
    seconds = "CPU seconds, all cores together" if second_of(chart) == "CPU second" else "seconds that pass"
    return (
        f"# In the scene, or filtered\n\n{command}{chart['device']}, graspd {chart['versions']['graspd']}, "
        f"{chart['created']}. Scene: {chart['scene']['kind']}, faces {chart['scene']['faces']}. Hands: {hands}. "
        f"Objects: {objects}.{remark}\n\n"
        f"- *{IN_SCENE}*: planned for the scene\n"
        f"- *{FILTERED}*: planned around a free object and put into the same scenes, grasp i into scene i in turn: all "
        "that peers can do\n"
        "- *clear*: free of what stands there, coming, closing and lifting\n"
        "- *lifted*: clear, and lifted by MuJoCo (level *lift*); *dexgraspbench*: lifted in DexGraspBench's test; "
        "*half friction*: lifted at that too; shares of all candidates\n"
        f"- *robust*: share of {chart['models']} models around the nominal one in which a lifted grasp is lifted, on "
        "average\n"
        f"- speed: lifted grasps over {seconds}, end to end: planner, postures, way, lift, and "
        "the metrics of what is lifted; *planner's*: over those of planner and postures\n"
        "- bars: 95 % (Wilson); hollow: none was lifted, the most that there can be"
    )


def _summary(rows: Sequence[Row], second: str) -> str:
    lines = [
        "| way | method | fidelity | n | clear | lifted | dexgraspbench | half friction | robust | "
        f"lifted per {second} | planner's | first, {second.removesuffix('econd')} | pairs with one | "
        "× over filtered |",
        "| --- | --- | --- | --: | --: | --: | --: | --: | --: | --: | --: | --: | --: | --: |",
    ]
    for row in rows:
        gain = "–" if row["gain"] is None else f"{row['gain']:.3g}"
        lines.append(
            f"| {row['way']} | {row['method']} | {row['fidelity']} | {row['grasps']} | {row['clear']:.2f} | "
            f"{' | '.join(_bold(row, key) for key in ACCURACIES)} | "
            f"{row[SPEED]:.3g} | {row['valid_per_second']:.3g} | {first(row['seconds_to_first'])} | "
            f"{row['pairs_with_one']} of {row['pairs']} | {gain} |"
        )
    note = (
        "× over filtered: planner's speed, median of the pairs in which the same fidelity, filtered, had any at all. "
        "Bold: nobody faster is better."
    )
    return "\n".join(lines) + f"\n\n{note}"


def _bold(row: Row, key: str) -> str:
    return f"**{share(row[key])}**" if key in row["front"] else share(row[key])


def _runs(runs: Sequence[Row], second: str) -> str:
    lines = [
        "| hand | object | way | method | fidelity | n | clear | lifted | dexgraspbench | half friction | robust | "
        f"lifted per {second} |",
        "| --- | --- | --- | --- | --- | --: | --: | --: | --: | --: | --: | --: |",
    ]
    lines += [
        f"| {run['hand']} | {run['object']} | {run['way']} | {run['method']} | {run['fidelity']} | {run['grasps']} | "
        f"{run['clear']:.2f} | {run['lift']:.2f} | {run['lift_dexgraspbench']:.2f} | {run['lift_hard']:.2f} | "
        f"{share(run['robust'])} | {run[SPEED]:.3g} |"
        for run in runs
    ]
    return "\n".join(lines)
