"""Plots of a chart: accuracy over speed with bars, labels and Pareto front, in total and per hand."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

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
    _set_logarithmic(axes, [label.x * (0.5 if "0 of" in label.text else 1.0) for label in labels])
    top = max([row[f"{y}_high"] for row in rows] or [1.0])
    axes.set_ylim(-0.09 * top, 1.08 * top)
    plain_axes(axes)
    return labels


def error_bar_ends(row: Row, key: str) -> tuple[float, float] | None:
    return (row[f"{key}_low"], row[f"{key}_high"]) if f"{key}_low" in row else None


def _set_logarithmic(axes: Any, values: Sequence[float]) -> None:
    """Set a logarithmic axis of at least one decade, with plain numbers and space for labels on the right."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.set_xscale("log")
    low, high = min(values, default=1.0), max(values, default=1.0)
    wider = max(1.0, (10 / (high / low)) ** 0.5)
    axes.set_xlim(low / wider / 1.4, high * wider * 2.2)
    # With more than four decades intermediate numbers would overlap.
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0,) if high > 1e3 * low else (1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())


def error_bar(row: Row, key: str) -> list[list[float]]:
    return [[max(0.0, row[key] - row[f"{key}_low"])], [max(0.0, row[f"{key}_high"] - row[key])]]


def _label(row: Row, rows: Rows) -> str:
    """Return fidelity, and batch size if it varies; the method's name if it has only one setting."""
    own = [r for r in rows if r["method"] == row["method"]]
    if len(own) == 1:
        return str(row["method"])
    several = len({r["batch"] for r in own}) > 1
    return f"{row['fidelity']}, {row['batch']}" if several else str(row["fidelity"])


Boxes = NDArray[np.float64]

SIZE_PT: Final = 8
#: Distances of a label from its point [pt], preferred ones first.
_REACHES_PT: Final = (8.0, 15.0, 26.0, 38.0, 52.0)
#: Directions from the point, preferred ones first [degrees].
_TURNS: Final = (30, -30, 150, -150, 90, -90, 0, 180, 60, -60, 120, -120)
#: Half the width of a marker [pt], and of a bar.
_MARKER_PT: Final = 5.5
_BAR_PT: Final = 1.5
#: Cost per share of a label that is covered by another label or a point, covered by a bar, or outside the panel.
_COVERED, _CROSSED, _OUTSIDE = 100.0, 8.0, 200.0
#: Cost of the next distance, of a label nearer to another point, and of the next direction.
_FARTHER, _TAKEN, _TURNED = 1.0, 2.5, 0.05
_ROUNDS: Final = 6


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
    """Place the labels of all panels in an otherwise complete figure; return the new annotations."""
    figure.draw_without_rendering()
    made = []
    for axes in dict.fromkeys(label.axes for label in labels):
        made += _place_labels_on_axes(axes, figure.dpi / 72.0, [label for label in labels if label.axes is axes])
    return made


def _place_labels_on_axes(axes: Any, pixels: float, labels: Sequence[Label]) -> list[Any]:
    points = axes.transData.transform([(label.x, label.y) for label in labels])
    markers = np.hstack([points - _MARKER_PT * pixels, points + _MARKER_PT * pixels])
    bars = _error_bar_boxes(axes, labels, _BAR_PT * pixels)
    panel = axes.get_window_extent()
    inside = np.array([panel.x0, panel.y0, panel.x1, panel.y1])
    worded = [index for index, label in enumerate(labels) if label.text]
    offered = {index: _label_positions(points[index], _text_size(axes, labels[index].text), pixels) for index in worded}
    fixed = {index: _fixed_costs(offered[index], points, index, bars, inside) for index in worded}
    chosen = dict.fromkeys(worded, 0)
    # Each label in turn moves to the best place among the other labels, until no label moves.
    for _ in range(_ROUNDS):
        before = dict(chosen)
        for index in worded:
            solid = np.vstack([markers, *(offered[other][chosen[other]] for other in worded if other != index)])
            costs = [_COVERED * _covered_share(box, solid) for box in offered[index]]
            chosen[index] = int(np.argmin(np.array(costs) + fixed[index]))
        if chosen == before:
            break
    made = []
    for index, at in chosen.items():
        box = offered[index][at]
        # A line connects a label with its point if the label is far away or nearer to another point.
        led = at // len(_TURNS) > 1 or _is_nearer_to_another(box, points, index)
        made.append(_draw_label(axes, labels[index], points[index], box, pixels, led=led))
    return made


def _fixed_costs(boxes: Sequence[Boxes], points: Boxes, own: int, bars: Boxes, inside: Boxes) -> Boxes:
    return np.array(
        [
            _CROSSED * _covered_share(box, bars)
            + _OUTSIDE * (1.0 - _covered_share(box, inside[None]))
            + _FARTHER * (at // len(_TURNS))
            + _TURNED * (at % len(_TURNS))
            + _TAKEN * _is_nearer_to_another(box, points, own)
            for at, box in enumerate(boxes)
        ]
    )


def _is_nearer_to_another(box: Boxes, points: Boxes, own: int) -> bool:
    away = np.linalg.norm(points - np.clip(points, box[:2], box[2:]), axis=1)
    return bool(np.any(np.delete(away, own) < away[own]))


def _draw_label(axes: Any, label: Label, point: Boxes, box: Boxes, pixels: float, *, led: bool) -> Any:
    from matplotlib.patheffects import withStroke

    offset = (box[:2] - point) / pixels
    line = {"arrowstyle": "-", "color": label.colour, "linewidth": 0.6, "alpha": 0.7, "shrinkA": 0, "shrinkB": 4}
    style = {"fontsize": SIZE_PT, "color": label.colour, "ha": "left", "va": "bottom", "zorder": 4}
    style |= {"arrowprops": line if led else None, "path_effects": [withStroke(linewidth=2, foreground="white")]}
    where = {"xytext": offset, "textcoords": "offset points", "annotation_clip": False}
    note = axes.annotate(label.text, (label.x, label.y), **where, **style)
    # The layout was computed without labels: they must not move the panels.
    note.set_in_layout(False)
    return note


def _text_size(axes: Any, text: str) -> tuple[float, float]:
    """Return width and height of a label [px]."""
    sample = axes.annotate(text, (0.5, 0.5), xycoords="axes fraction", fontsize=SIZE_PT)
    extent = sample.get_window_extent()
    sample.remove()
    return float(extent.width), float(extent.height)


def _label_positions(point: Boxes, size: tuple[float, float], pixels: float) -> list[Boxes]:
    """Return boxes (left, bottom, right, top) [px] around the point, preferred ones first."""
    found = []
    for reach, turn in product(_REACHES_PT, _TURNS):
        across, up = math.cos(math.radians(turn)), math.sin(math.radians(turn))
        corner = point + reach * pixels * np.array([across, up])
        # The label's nearest corner or side touches this place.
        left = corner[0] - size[0] * (0.5 - 0.5 * _side(across))
        bottom = corner[1] - size[1] * (0.5 - 0.5 * _side(up))
        found.append(np.array([left, bottom, left + size[0], bottom + size[1]]))
    return found


def _side(part: float) -> float:
    return 0.0 if abs(part) < 0.2 else math.copysign(1.0, part)


def _error_bar_boxes(axes: Any, labels: Sequence[Label], half: float) -> Boxes:
    ends = [((low, label.y), (high, label.y)) for label in labels if label.x_bar for low, high in [label.x_bar]]
    ends += [((label.x, low), (label.x, high)) for label in labels if label.y_bar for low, high in [label.y_bar]]
    if not ends:
        return np.empty((0, 4))
    least = axes.get_xlim()[0]
    seen = [[(max(x, least), y) for x, y in pair] for pair in ends]
    corners = axes.transData.transform(np.reshape(seen, (-1, 2))).reshape(-1, 4)
    return np.hstack([corners[:, :2] - half, corners[:, 2:] + half])


def _covered_share(box: Boxes, boxes: Boxes) -> float:
    """Return the covered share of a box's area; overlaps count for each covering box."""
    if not len(boxes):
        return 0.0
    across = np.minimum(box[2], boxes[:, 2]) - np.maximum(box[0], boxes[:, 0])
    up = np.minimum(box[3], boxes[:, 3]) - np.maximum(box[1], boxes[:, 1])
    area = (box[2] - box[0]) * (box[3] - box[1])
    return float((np.clip(across, 0, None) * np.clip(up, 0, None)).sum() / area)
