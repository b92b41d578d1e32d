"""Failure maps as JSON, Markdown and plots."""

import json
import math
import textwrap
from pathlib import Path
from typing import Any, Final

from graspd.service.model import studies
from graspd.studies.figures import TEMPLATES, new_figure

#: Colours (fill, text) by outcome, distinguishable by lightness alone.
COLOURS: Final = {
    "good": ("#bfe0dc", "#14403a"),
    "weak": ("#eeb544", "#3b2a00"),
    "broken": ("#96261c", "#ffffff"),
    "refused": ("#e7e9ec", "#4b565e"),
}
_COLUMNS: Final = 3  # largest number of panels in a row
#: Sizes of the numbers on cells [pt], largest first; if the last does not fit, the cell is blank.
_FONT_SIZES: Final = (7.0, 6.0, 5.0)
_TICK_LETTERS: Final = 14  # tick labels are wrapped at this number of characters


def write(found: studies.Stability, folder: Path) -> list[Path]:
    """Write `stability.json`, `stability.md` and a plot of each map; return the files."""
    folder.mkdir(parents=True, exist_ok=True)
    written = [folder / "stability.json", folder / "stability.md"]
    written[0].write_text(json.dumps(found.as_json(), indent=1, allow_nan=False) + "\n")
    written[1].write_text(markdown(found))
    for one in found.maps:
        written.append(folder / f"stability-{one.name}.png")
        draw(one, written[-1])
    return written


def markdown(found: studies.Stability) -> str:
    """Return a page in Markdown: remaining failures, then each map with symptom, guard and test."""
    page = TEMPLATES.get_template("stability/page.md.j2")
    return page.render(vars(found), count_outcomes=studies.count_outcomes)


def draw(one: studies.StabilityMap, path: Path) -> None:
    """Plot a map with a square per cell."""
    from matplotlib.patches import Patch

    panels = one.panels
    columns = min(_COLUMNS, len(panels))
    rows = math.ceil(len(panels) / columns)
    tallest = max(len({cell.y for cell in one.panel_cells(panel)}) for panel in panels)
    height = min(3.4, 1.0 + 0.5 * tallest)
    figure = new_figure(max(4.4 * columns, 7.0), height * rows + 0.9)
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes, panel in zip(grid.flat, panels, strict=False):
        _panel(axes, one, panel)
    for axes in list(grid.flat)[len(panels) :]:
        axes.set_visible(False)
    present = [outcome for outcome, number in studies.count_outcomes(one.cells).items() if number]
    handles = [Patch(color=COLOURS[outcome][0], label=outcome) for outcome in studies.OUTCOMES if outcome in present]
    if one.is_partly_reachable:
        handles.append(Patch(facecolor="none", edgecolor="#14191d", linewidth=1.4, label="a job can reach this"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    figure.suptitle(one.title, x=0.01, ha="left", fontsize=13, fontweight="bold")
    figure.draw_without_rendering()
    for axes in grid.flat:
        # Numbers shrink to fit their cells, or are omitted.
        left, right = axes.get_xlim()
        room = 0.88 * axes.get_window_extent().width / max(1.0, right - left)
        for text in axes.texts:
            for size in _FONT_SIZES:
                text.set_fontsize(size)
                if text.get_window_extent().width <= room:
                    break
            else:
                text.set_visible(False)
    figure.savefig(path, dpi=110)


def _panel(axes: Any, one: studies.StabilityMap, panel: str) -> None:
    from matplotlib.patches import Rectangle

    cells = one.panel_cells(panel)
    xs, ys = (list(dict.fromkeys(getattr(cell, axis) for cell in cells)) for axis in ("x", "y"))
    for cell in cells:
        at = xs.index(cell.x), ys.index(cell.y)
        fill, ink = COLOURS[cell.outcome]
        framed = cell.reached and one.is_partly_reachable
        edge: dict[str, Any] = {"edgecolor": "#14191d", "linewidth": 1.4} if framed else {"linewidth": 0}
        axes.add_patch(Rectangle((at[0] - 0.46, at[1] - 0.46), 0.92, 0.92, facecolor=fill, **edge))
        axes.text(*at, cell.text, ha="center", va="center", color=ink)
    axes.set(xlim=(-0.5, len(xs) - 0.5), ylim=(-0.5, len(ys) - 0.5))
    axes.set_xticks(range(len(xs)), [_wrap_label(x) for x in xs], fontsize=8)
    axes.set_yticks(range(len(ys)), [_wrap_label(y) for y in ys], fontsize=8)
    axes.set_xlabel(one.x, fontsize=9)
    axes.set_ylabel(one.y, fontsize=9)
    axes.set_title(panel, loc="left", fontsize=10)
    axes.spines[:].set_visible(False)
    axes.tick_params(length=0)
    if line := one.lines.get(panel):
        axes.plot(
            [studies.tick_position(xs, x) for x, _ in line],
            [studies.tick_position(ys, y) for _, y in line],
            color="#1f2937",
            lw=1.6,
            ls="--",
        )


def _wrap_label(value: float | str) -> str:
    return textwrap.fill(studies.format_tick(value), _TICK_LETTERS, break_long_words=False)
