"""Maps of failure as JSON, Markdown and pictures."""

from __future__ import annotations

import json
import math
from bisect import bisect_right
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from worker.studies.stability.maps import OUTCOMES, Cell, StabilityMap

COLOURS: Final = {"good": "#3f9b82", "weak": "#e6b450", "broken": "#b3392f", "refused": "#9aa4b1"}
#: Widest row of panels.
_COLUMNS: Final = 3


def write(maps: Sequence[StabilityMap], folder: Path, *, command: str, versions: dict[str, str]) -> list[Path]:
    """`stability.json`, `stability.md` and a picture for each map."""
    folder.mkdir(parents=True, exist_ok=True)
    written = [folder / "stability.json", folder / "stability.md"]
    record = {"command": command, "versions": versions, "maps": [one.as_json() for one in maps]}
    written[0].write_text(json.dumps(_plain(record), indent=1) + "\n")
    written[1].write_text(markdown(maps, command=command, versions=versions))
    for one in maps:
        written.append(folder / f"stability-{one.name}.png")
        draw(one, written[-1])
    return written


def markdown(maps: Sequence[StabilityMap], *, command: str, versions: dict[str, str]) -> str:
    """What was driven where, where it broke, how that shows, and what guards against it."""
    said = ", ".join(f"{name} {value}" for name, value in versions.items())
    lines = ["# Where it breaks", "", f"`{command}`; {said}.", ""]
    for one in maps:
        lines += [f"## {one.title}", "", f"![{one.title}](stability-{one.name}.png)", ""]
        lines += [f"Measure: {one.measure}. {one.bounds[0].upper()}{one.bounds[1:]}.", ""]
        lines += ["| panel | good | weak | broken | refused |", "| --- | --: | --: | --: | --: |"]
        for panel in one.panels:
            counts = [sum(c.panel == panel and c.outcome == outcome for c in one.cells) for outcome in OUTCOMES]
            lines.append(f"| {panel} | " + " | ".join(map(str, counts)) + " |")
        lines += ["", f"- shows as: {one.shows}", f"- guard: {one.guard}"]
        if one.guard_test:
            lines.append(f"- test of the guard: `{one.guard_test}`")
        lines.append("")
    return "\n".join(lines)


def draw(one: StabilityMap, path: Path) -> None:
    """A panel for each method or family, a square for each cell."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    panels = one.panels
    columns = min(_COLUMNS, len(panels))
    rows = math.ceil(len(panels) / columns)
    figure = Figure(figsize=(4.4 * columns, 3.4 * rows + 0.9), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes, panel in zip(grid.flat, panels, strict=False):
        _panel(axes, one, panel)
    for axes in list(grid.flat)[len(panels) :]:
        axes.set_visible(False)
    present = [outcome for outcome in OUTCOMES if any(cell.outcome == outcome for cell in one.cells)]
    figure.legend(
        handles=[Patch(color=COLOURS[outcome], label=outcome) for outcome in present],
        loc="outside lower center", ncols=len(present), frameon=False,
    )  # fmt: skip
    figure.suptitle(one.title, x=0.01, ha="left", fontsize=13, fontweight="bold")
    figure.savefig(path, dpi=110)


def _panel(axes: Any, one: StabilityMap, panel: str) -> None:
    cells = [cell for cell in one.cells if cell.panel == panel]
    xs, ys = (list(dict.fromkeys(getattr(cell, axis) for cell in cells)) for axis in ("x", "y"))
    for cell in cells:
        at = xs.index(cell.x), ys.index(cell.y)
        axes.add_patch(_square(at, cell))
        if cell.label or math.isfinite(cell.value):
            axes.text(*at, cell.label or f"{cell.value:.2g}", ha="center", va="center", fontsize=7, color="white")
    axes.set_xlim(-0.5, len(xs) - 0.5)
    axes.set_ylim(-0.5, len(ys) - 0.5)
    axes.set_xticks(range(len(xs)), [_label(x) for x in xs], fontsize=8, rotation=30 if len(xs) > 5 else 0)
    axes.set_yticks(range(len(ys)), [_label(y) for y in ys], fontsize=8)
    axes.set_xlabel(one.x, fontsize=9)
    axes.set_ylabel(one.y, fontsize=9)
    axes.set_title(panel, loc="left", fontsize=10)
    axes.spines[:].set_visible(False)
    axes.tick_params(length=0)
    if line := one.lines.get(panel):
        axes.plot(
            [_between(xs, x) for x, _ in line], [_between(ys, y) for _, y in line], color="#1f2937", lw=1.6, ls="--"
        )


def _square(at: tuple[int, int], cell: Cell) -> Any:
    from matplotlib.patches import Rectangle

    return Rectangle((at[0] - 0.47, at[1] - 0.47), 0.94, 0.94, color=COLOURS[cell.outcome], lw=0)


def _between(ticks: Sequence[Any], value: float) -> float:
    """Where a value lies among logarithmic ticks, beyond their ends too."""
    logs, at = [math.log(tick) for tick in ticks], math.log(value)
    if len(logs) < 2:
        return 0.0
    k = min(max(bisect_right(logs, at) - 1, 0), len(logs) - 2)
    return k + (at - logs[k]) / (logs[k + 1] - logs[k])


def _label(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:g}"


def _plain(value: Any) -> Any:
    """Without nan and infinity, which JSON does not know."""
    if isinstance(value, dict):
        return {key: _plain(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
