"""Plots of a chart: accuracy over speed with bars, labels and Pareto front, in total and per hand."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from graspd.studies.chart.statistics import valid_rate_bound
from graspd.studies.figures import COLOURS, INK, new_figure, plain_axes

Row = Mapping[str, Any]
Rows = Sequence[Row]
PointLabel = Callable[[Row, Rows], str]  # function from a point's row and all rows to its label
Styles = Mapping[str, tuple[str, str]]  # colour and marker of each method

#: Title and key of each accuracy.
PANELS: Final = (
    ("Success under the DexGraspBench protocol", "dexgraspbench"),
    ("Success at half the friction", "hard"),
    ("Robust share of held grasps", "robust"),
    ("ε (median)", "epsilon"),
    ("Penetration, mm (median; less is better)", "pd_mm"),
)
SPEED: Final = "end_to_end_per_second"
#: Keys of accuracies that are shares.
OF_ONE: Final = frozenset({"dexgraspbench", "hard", "robust", "lift", "lift_dexgraspbench", "lift_hard"})
MARKERS: Final = ("o", "s", "D", "^", "v", "P", "X", "<")


def draw(rows: Rows, files: Sequence[Path]) -> None:
    """Plot accuracies over valid grasps per second, and success over seconds to the first valid grasp."""
    figure = new_figure(15.5, 8.6)
    panels = figure.subplots(2, 3)
    styles, words = method_styles(rows), "valid grasps per second, end to end"
    labels = []
    for axes, (title, key) in zip(panels.flat[:5], PANELS, strict=True):
        labels += draw_over_speed(axes, rows, styles, key, title, words)
    last, timed = panels.flat[5], [row for row in rows if row["seconds_to_first_valid"]]
    labels += draw_panel(last, timed, styles, x="seconds_to_first_valid", y="dexgraspbench")
    last.set(xlabel="seconds to the first valid grasp, end to end (less is better)", ylim=(-0.07, 1.04))
    last.set_title("Success under the DexGraspBench protocol", loc="left", fontsize=11)
    figure.legend(*panels.flat[0].get_legend_handles_labels(), loc="outside lower center", ncols=6, frameon=False)
    save(figure, labels, files)


def draw_hands(
    by_hand: Mapping[str, Rows], file: Path, *, key: str, words: tuple[str, str], label: PointLabel | None = None
) -> None:
    """Plot a panel per hand, accuracy over speed; `words` has the axis labels, `label` labels a point."""
    columns = min(3, len(by_hand))
    lines = -(-len(by_hand) // columns)
    figure = new_figure(5.4 * max(columns, 2), 4.6 * lines)
    panels = figure.subplots(lines, columns, squeeze=False)
    styles = method_styles([row for rows in by_hand.values() for row in rows])
    labels = []
    for axes, (hand, rows) in zip(panels.flat, by_hand.items(), strict=False):
        labels += draw_over_speed(axes, rows, styles, key, hand, words[1], label)
    for axes in panels.flat[len(by_hand) :]:
        axes.set_visible(False)
    figure.supylabel(words[0], fontsize=10)
    figure.legend(*panels.flat[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    save(figure, labels, [file])


def save(figure: Any, labels: Sequence[Label], files: Sequence[Path]) -> None:
    place_labels(figure, labels)
    for file in files:
        figure.savefig(file, dpi=150)


def draw_over_speed(
    axes: Any, rows: Rows, styles: Styles, key: str, title: str, words: str, label: PointLabel | None = None
) -> list[Label]:
    """Plot one accuracy over the speed, with the Pareto front; return the labels of the points."""
    known = [row for row in rows if row[key] is not None]
    labels = draw_panel(axes, known, styles, x=SPEED, y=key, label=label)
    front = sorted((row for row in known if key in row["front"] and row[SPEED]), key=lambda row: row[SPEED])
    style = {"color": INK, "linewidth": 1, "linestyle": "--", "alpha": 0.6, "zorder": 1, "label": "Pareto front"}
    axes.step([row[SPEED] for row in front], [row[key] for row in front], where="pre", **style)
    axes.set_xlabel(words)
    axes.set_title(title, loc="left", fontsize=11)
    if key in OF_ONE:
        axes.set_ylim(-0.07, 1.07)
    return labels


def method_styles(rows: Rows) -> Styles:
    methods = list(dict.fromkeys(row["method"] for row in rows))
    return {m: (COLOURS[i % len(COLOURS)], MARKERS[i % len(MARKERS)]) for i, m in enumerate(methods)}


def draw_panel(
    axes: Any, rows: Rows, styles: Styles, *, x: str, y: str, label: PointLabel | None = None
) -> list[Label]:
    shown: set[str] = set()
    labels = []
    for row in rows:
        colour, marker = styles[row["method"]]
        # Without valid grasps a hollow marker with an arrow to lower values is at the upper bound.
        none = not row[x]
        at = valid_rate_bound(row) if none else row[x]
        bars: dict[str, Any] = {
            f"{axis}err": error_bar(row, key) for axis, key in (("x", x), ("y", y)) if f"{key}_low" in row
        }
        if none:
            bars |= {"xerr": [[0.55 * at], [0.0]], "xuplims": True}
        edge, face = (colour, "white") if none else ("white", colour)
        bars |= {"ecolor": colour, "elinewidth": 1, "capsize": 2}
        bars |= {"fmt": marker, "markersize": 7, "markeredgecolor": edge, "markerfacecolor": face}
        name = None if row["method"] in shown else row["method"]
        axes.errorbar(at, row[y], **bars, color=colour, label=name, zorder=3)
        shown.add(row["method"])
        text = (label or _label)(row, rows)
        words = ", ".join(filter(None, (text, f"0 of {row['grasps']}" * none)))
        ends = {
            f"{axis}_bar": error_bar_ends(row, key) for axis, key in (("x", x), ("y", y)) if not (none and axis == "x")
        }
        labels.append(Label(axes, at, row[y], words, colour, **({"x_bar": (0.45 * at, at)} if none else {}), **ends))
    # The axis has at least one decade, plain numbers, and space for labels on the right.
    values = [label.x * (0.5 if "0 of" in label.text else 1.0) for label in labels]
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.set_xscale("log")
    low, high = min(values, default=1.0), max(values, default=1.0)
    wider = max(1.0, (10 / (high / low)) ** 0.5)
    axes.set_xlim(low / wider / 1.4, high * wider * 2.2)
    # With more than four decades intermediate numbers would overlap.
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0,) if high > 1e3 * low else (1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    top = max([row[f"{y}_high"] for row in rows] or [1.0])
    axes.set_ylim(-0.09 * top, 1.08 * top)
    plain_axes(axes)
    return labels


def error_bar_ends(row: Row, key: str) -> tuple[float, float] | None:
    return (row[f"{key}_low"], row[f"{key}_high"]) if f"{key}_low" in row else None


def error_bar(row: Row, key: str) -> list[list[float]]:
    return [[max(0.0, row[key] - row[f"{key}_low"])], [max(0.0, row[f"{key}_high"] - row[key])]]


def _label(row: Row, rows: Rows) -> str:
    """Return fidelity, and batch size if it varies; the method's name if it has only one setting."""
    own = [r for r in rows if r["method"] == row["method"]]
    if len(own) == 1:
        return str(row["method"])
    several = len({r["batch"] for r in own}) > 1
    return f"{row['fidelity']}, {row['batch']}" if several else str(row["fidelity"])


SIZE_PT: Final = 8  # size of labels
_ALONG_BAR: Final = 5  # number of places on a bar that labels avoid
_ROUNDS: Final = 500
#: Space around labels, as factors on their sizes, and weights of moves away from labels and from points (x, y).
_SPACING: Final[dict[str, Any]] = {"expand": (1.2, 1.6), "force_text": (0.3, 0.5), "force_static": (0.2, 0.4)}


@dataclass(frozen=True)
class Label:
    """A label at a point of a panel."""

    axes: Any
    x: float
    y: float
    text: str
    colour: str
    x_bar: tuple[float, float] | None = None  # ends of the point's error bars
    y_bar: tuple[float, float] | None = None


def place_labels(figure: Any, labels: Sequence[Label]) -> list[Any]:
    """Place the labels of all panels in an otherwise complete figure; return the new texts."""
    figure.draw_without_rendering()
    return [
        text
        for axes in dict.fromkeys(label.axes for label in labels)
        for text in _place_labels_on_axes(axes, [label for label in labels if label.axes is axes])
    ]


def _place_labels_on_axes(axes: Any, labels: Sequence[Label]) -> list[Any]:
    from adjustText import adjust_text
    from matplotlib.patheffects import withStroke

    left = axes.get_xlim()[0]
    bars = [
        ((max(low, left), label.y), (high, label.y)) for label in labels if label.x_bar for low, high in [label.x_bar]
    ]
    bars += [((label.x, low), (label.x, high)) for label in labels if label.y_bar for low, high in [label.y_bar]]
    ends = axes.transData.transform(np.reshape(bars, (-1, 2))).reshape(-1, 2, 2)
    along = np.linspace(ends[:, 0], ends[:, 1], _ALONG_BAR).reshape(-1, 2)
    # Labels keep away from the points, and from places along their bars.
    places = np.concatenate([[(label.x, label.y) for label in labels], axes.transData.inverted().transform(along)])
    worded = [label for label in labels if label.text]
    texts = []
    for label in worded:
        style = {"color": label.colour, "path_effects": [withStroke(linewidth=2, foreground="white")], "zorder": 4}
        texts.append(axes.text(label.x, label.y, label.text, fontsize=SIZE_PT, clip_on=False, **style))
        # The layout was computed without labels: they must not move the panels.
        texts[-1].set_in_layout(False)
    line = {"arrowstyle": "-", "color": INK, "linewidth": 0.6, "alpha": 0.7, "shrinkB": 4}
    adjust_text(texts, *places.T, ax=axes, iter_lim=_ROUNDS, arrowprops=line, **_SPACING)
    return texts
