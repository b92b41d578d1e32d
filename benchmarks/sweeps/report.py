"""A sweep as JSON, Markdown and plot."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from graspd.studies.chart.figure import Label, Row, error_bar, error_bar_ends, save
from graspd.studies.chart.report import value_with_error
from graspd.studies.figures import COLOURS, INK, markdown_table, new_figure, plain_axes


def write(sweep: Row, folder: Path) -> None:
    """Write sweeps.{json,md,png}; `sweep` has command, device, threads, versions, time, and rows."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "sweeps.json").write_text(json.dumps(sweep, indent=1, allow_nan=False) + "\n")
    draw(sweep["rows"], folder / "sweeps.png")
    (folder / "sweeps.md").write_text(markdown(sweep) + "\n")


def markdown(sweep: Row) -> str:
    """Return the sweep as a page in Markdown."""
    one, versions = sweep["rows"][0], sweep["versions"]
    return (
        f"# Cost and benefit of each setting\n\n    {sweep['command']}\n\n"
        f"{sweep['device']}, {sweep['threads']} threads, graspd {versions['graspd']}, Warp {versions['warp']}, "
        f"{sweep['created']}.\n\n"
        f"{one['hand']} on {one['object']}, {one['grasps']} grasps per value. Each row changes one setting of fidelity "
        "*standard*; pairs of numbers are for the coarse and the fine phase. Speed is relative to the default.\n\n"
        f"![Settings](sweeps.png)\n\n{table(sweep['rows'])}"
    )


def draw(rows: Sequence[Row], file: Path) -> None:
    """Plot a panel per setting: success over speed, a point per value."""
    knobs = list(dict.fromkeys(row["knob"] for row in rows))
    columns = 3
    lines = -(-len(knobs) // columns)
    figure = new_figure(11, 3.1 * lines)
    panels = figure.subplots(lines, columns, squeeze=False, sharex=True, sharey=True)
    labels = []
    for axes, knob in zip(panels.flat, knobs, strict=False):
        own = sorted((r for r in rows if r["knob"] == knob), key=lambda r: r["speedup"])
        axes.plot([r["speedup"] for r in own], [r["gsr"] for r in own], color=COLOURS[0], alpha=0.4)
        for row in own:
            face = COLOURS[0] if row["default"] else "white"
            style = {"fmt": "o", "color": COLOURS[0], "markerfacecolor": face, "markersize": 6}
            axes.errorbar(row["speedup"], row["gsr"], yerr=error_bar(row, "gsr"), capsize=2, elinewidth=1, **style)
            labels.append(
                Label(axes, row["speedup"], row["gsr"], str(row["value"]), INK, y_bar=error_bar_ends(row, "gsr"))
            )
        axes.set_title(knob, loc="left", fontsize=10)
        axes.set_ylim(0, 1.05)
        plain_axes(axes)
    for axes in panels.flat[len(knobs) :]:
        axes.set_visible(False)
    # All panels share an axis from zero, so that differences are comparable.
    panels.flat[0].set_xlim(0, 1.35 * max(row["speedup"] for row in rows))
    for axes in panels.flat[len(knobs) - columns : len(knobs)]:
        axes.tick_params(labelbottom=True)
    figure.supxlabel("speed relative to the default (filled marker)", fontsize=10)
    figure.supylabel("success in MuJoCo", fontsize=10)
    save(figure, labels, [file])


def table(rows: Sequence[Row]) -> str:
    """Return a row per value of a setting: speed and accuracy, and the speed relative to the default."""
    found = []
    for row in rows:
        cells = [row["knob"], f"{row['value']}{' (default)' if row['default'] else ''}"]
        cells += [f"{1.0 / row['grasps_per_second']:.3g}", f"× {row['speedup']:.2f}"]
        accuracies = (("gsr", ".2f"), ("epsilon", ".3f"), ("pd_mm", ".2f"))
        found.append([*cells, *(value_with_error(row, key, form) for key, form in accuracies)])
    return markdown_table("setting | value | s/grasp | speed | GSR | ε | penetration mm", found, left=2)
