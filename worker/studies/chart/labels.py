"""Words beside the points of a plot, so placed that none lies on another word, a point or its bars."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Boxes = NDArray[np.float64]

SIZE_PT: Final = 8
#: Distances of a word from its point [pt], the wanted one first: from the third on a line leads to it.
_REACHES_PT: Final = (8.0, 15.0, 26.0, 38.0, 52.0)
#: Directions from the point, the wanted ones first [degrees].
_TURNS: Final = (30, -30, 150, -150, 90, -90, 0, 180, 60, -60, 120, -120)
#: Half of a marker's width [pt], and half of a bar's.
_MARKER_PT: Final = 5.5
_BAR_PT: Final = 1.5
#: What a covered share of a word costs: by another word or a point, by a bar, outside of the panel.
_COVERED, _CROSSED, _OUTSIDE = 100.0, 8.0, 200.0
#: What it costs to be farther away by a reach, to be nearer to another point, and to take the next direction.
_FARTHER, _TAKEN, _TURNED = 1.0, 2.5, 0.05
_ROUNDS: Final = 6


@dataclass(frozen=True)
class Label:
    """A word at a point of a panel."""

    axes: Any
    x: float
    y: float
    text: str
    colour: str
    x_bar: tuple[float, float] | None = None
    """Ends of the point's bars."""
    y_bar: tuple[float, float] | None = None


def place(figure: Any, labels: Sequence[Label]) -> list[Any]:
    """Put the words of all panels into a figure that has everything else; the annotations that it got."""
    figure.draw_without_rendering()
    made = []
    for axes in dict.fromkeys(label.axes for label in labels):
        made += _place(axes, figure.dpi / 72.0, [label for label in labels if label.axes is axes])
    return made


def _place(axes: Any, pixels: float, labels: Sequence[Label]) -> list[Any]:
    points = axes.transData.transform([(label.x, label.y) for label in labels])
    markers = np.hstack([points - _MARKER_PT * pixels, points + _MARKER_PT * pixels])
    bars = _bars(axes, labels, _BAR_PT * pixels)
    panel = axes.get_window_extent()
    inside = np.array([panel.x0, panel.y0, panel.x1, panel.y1])
    worded = [index for index, label in enumerate(labels) if label.text]
    offered = {index: _candidates(points[index], _size(axes, labels[index].text), pixels) for index in worded}
    fixed = {index: _fixed_costs(offered[index], points, index, bars, inside) for index in worded}
    chosen = dict.fromkeys(worded, 0)
    # Each in turn takes the best place beside the present ones of the others, until none moves.
    for _ in range(_ROUNDS):
        before = dict(chosen)
        for index in worded:
            solid = np.vstack([markers, *(offered[other][chosen[other]] for other in worded if other != index)])
            costs = [_COVERED * _share(box, solid) for box in offered[index]]
            chosen[index] = int(np.argmin(np.array(costs) + fixed[index]))
        if chosen == before:
            break
    return [
        _write(
            axes,
            labels[index],
            points[index],
            offered[index][at],
            pixels,
            led=_is_led(offered[index][at], points, index, at),
        )
        for index, at in chosen.items()
    ]


def _fixed_costs(boxes: Sequence[Boxes], points: Boxes, own: int, bars: Boxes, inside: Boxes) -> Boxes:
    """What the places of a word cost wherever the other words stand."""
    return np.array(
        [
            _CROSSED * _share(box, bars)
            + _OUTSIDE * (1.0 - _share(box, inside[None]))
            + _FARTHER * (at // len(_TURNS))
            + _TURNED * (at % len(_TURNS))
            + _TAKEN * _is_nearer_to_another(box, points, own)
            for at, box in enumerate(boxes)
        ]
    )


def _is_nearer_to_another(box: Boxes, points: Boxes, own: int) -> bool:
    away = np.linalg.norm(points - np.clip(points, box[:2], box[2:]), axis=1)
    return bool(np.any(np.delete(away, own) < away[own]))


def _is_led(box: Boxes, points: Boxes, own: int, at: int) -> bool:
    """Whether a line leads to a word: without it nobody would know whose it is."""
    return at // len(_TURNS) > 1 or _is_nearer_to_another(box, points, own)


def _write(axes: Any, label: Label, point: Boxes, box: Boxes, pixels: float, *, led: bool) -> Any:
    from matplotlib.patheffects import withStroke

    offset = (box[:2] - point) / pixels
    line = {"arrowstyle": "-", "color": label.colour, "linewidth": 0.6, "alpha": 0.7, "shrinkA": 0, "shrinkB": 4}
    note = axes.annotate(
        label.text,
        (label.x, label.y),
        xytext=offset,
        textcoords="offset points",
        fontsize=SIZE_PT,
        color=label.colour,
        ha="left",
        va="bottom",
        zorder=4,
        arrowprops=line if led else None,
        annotation_clip=False,
        path_effects=[withStroke(linewidth=2, foreground="white")],
    )
    # The layout was made without it: a word must not move the panels under the others.
    note.set_in_layout(False)
    return note


def _size(axes: Any, text: str) -> tuple[float, float]:
    """Width and height of a word [px]."""
    sample = axes.annotate(text, (0.5, 0.5), xycoords="axes fraction", fontsize=SIZE_PT)
    extent = sample.get_window_extent()
    sample.remove()
    return float(extent.width), float(extent.height)


def _candidates(point: Boxes, size: tuple[float, float], pixels: float) -> list[Boxes]:
    """Boxes around the point, (4,) each: left, bottom, right, top [px]; the wanted ones first."""
    found = []
    for reach, turn in product(_REACHES_PT, _TURNS):
        across, up = math.cos(math.radians(turn)), math.sin(math.radians(turn))
        corner = point + reach * pixels * np.array([across, up])
        # The word's nearest corner or side is at that place.
        left = corner[0] - size[0] * (0.5 - 0.5 * _side(across))
        bottom = corner[1] - size[1] * (0.5 - 0.5 * _side(up))
        found.append(np.array([left, bottom, left + size[0], bottom + size[1]]))
    return found


def _side(part: float) -> float:
    return 0.0 if abs(part) < 0.2 else math.copysign(1.0, part)


def _bars(axes: Any, labels: Sequence[Label], half: float) -> Boxes:
    """The bars of the points as boxes (N, 4) [px]."""
    ends = [((low, label.y), (high, label.y)) for label in labels if label.x_bar for low, high in [label.x_bar]]
    ends += [((label.x, low), (label.x, high)) for label in labels if label.y_bar for low, high in [label.y_bar]]
    if not ends:
        return np.empty((0, 4))
    least = axes.get_xlim()[0]
    seen = [[(max(x, least), y) for x, y in pair] for pair in ends]
    corners = axes.transData.transform(np.reshape(seen, (-1, 2))).reshape(-1, 4)
    return np.hstack([corners[:, :2] - half, corners[:, 2:] + half])


def _share(box: Boxes, boxes: Boxes) -> float:
    """How much of a box others cover; where they overlap it counts for each of them."""
    if not len(boxes):
        return 0.0
    across = np.minimum(box[2], boxes[:, 2]) - np.maximum(box[0], boxes[:, 0])
    up = np.minimum(box[3], boxes[:, 3]) - np.maximum(box[1], boxes[:, 1])
    area = (box[2] - box[0]) * (box[3] - box[1])
    return float((np.clip(across, 0, None) * np.clip(up, 0, None)).sum() / area)
