"""Charts as SVG that need no script: the geometry is made here, the templates only write it down."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final
from urllib.parse import urlencode

from api.models import Histogram
from service.index.queries.statistics import Distribution

#: Coordinates of a chart's inside; the SVG stretches it to the page.
WIDTH: Final = 600.0
HEIGHT: Final = 160.0


@dataclass(frozen=True)
class Plot:
    """A line or bars: SVG points for readers without a script, the numbers for the script."""

    label: str
    points: str
    data: str
    height: int = 180


@dataclass(frozen=True)
class Bar:
    """One bar of a histogram and the address of the grasps in it."""

    x: float
    y: float
    width: float
    height: float
    count: int
    low: float
    high: float
    href: str


def line(xs: Sequence[float], ys: Sequence[float], *, x: str, y: str, unit: str = "", log: bool = False) -> Plot:
    """A line through points; on a logarithmic axis values at or below zero are left out.

    Args:
        x: name of the horizontal axis with its unit.
        y: name of the values.
        unit: of the values.
    """
    kept = [(a, b) for a, b in zip(xs, ys, strict=True) if math.isfinite(b) and (b > 0 or not log)]
    scaled = [(a, math.log10(b) if log else b) for a, b in kept]
    low, high = (min(b for _, b in scaled), max(b for _, b in scaled)) if scaled else (0.0, 1.0)
    low = low if log else min(0.0, low)
    first, last = (scaled[0][0], scaled[-1][0]) if scaled else (0.0, 1.0)
    points = " ".join(
        f"{_share(a, first, last) * WIDTH:.1f},{HEIGHT - _share(b, low, high) * HEIGHT:.1f}" for a, b in scaled
    )
    data = {"kind": "line", "xs": [a for a, _ in kept], "ys": [b for _, b in kept], "x": x, "y": y, "unit": unit}
    label = f"{y} over {x}"
    if kept:
        label += f", from {kept[0][1]:.3g} to {kept[-1][1]:.3g} {unit}".rstrip()
    return Plot(label, points, json.dumps(data | {"log": log}))


def minutes(values: Sequence[int], start: float, *, step_s: int = 60) -> Plot:
    """Bars of what was made in each interval from `start` [s since 1970] on."""
    top = max([*values, 1])
    width = WIDTH / max(len(values), 1)
    points = " ".join(
        f"{i * width:.1f},{HEIGHT:.0f} {i * width:.1f},{HEIGHT * (1 - v / top):.1f} "
        f"{(i + 0.85) * width:.1f},{HEIGHT * (1 - v / top):.1f} {(i + 0.85) * width:.1f},{HEIGHT:.0f}"
        for i, v in enumerate(values)
    )
    data = {
        "kind": "bars",
        "xs": [start + i * step_s for i in range(len(values))],
        "ys": list(values),
        "x": "Time",
        "y": "Valid grasps",
        "unit": "/min",
        "log": False,
    }
    return Plot(
        f"Valid grasps in each minute of the last hour; at most {max(values, default=0)}", points, json.dumps(data)
    )


def bars(histogram: Histogram, path: str, where: dict[str, str]) -> list[Bar]:
    """The bars of a histogram; each leads to the grasps whose metric lies in it.

    Args:
        path: the page of the list.
        where: its other filters.
    """
    count = len(histogram.counts)
    width = (histogram.high - histogram.low) / count
    made = []
    for index, (share, number) in enumerate(zip(histogram.bars, histogram.counts, strict=True)):
        low, high = histogram.low + index * width, histogram.low + (index + 1) * width
        tall = max(60 * share, 1.5 if number else 0)
        query = where | {f"min_{histogram.metric}": f"{low:.6g}", f"max_{histogram.metric}": f"{high:.6g}"}
        made.append(Bar(10.0 * index + 1, 63 - tall, 8.0, tall, number, low, high, f"{path}?{urlencode(query)}"))
    return made


@dataclass(frozen=True)
class TwinBar:
    """Shares of two sets of grasps in one bin, side by side."""

    x: float
    one: float
    other: float
    """Heights."""
    low: float
    high: float
    shares: tuple[float, float]


def twins(both: Sequence[Distribution | None]) -> list[TwinBar]:
    """The bins of two distributions over the same range, each a share of its own grasps."""
    first = next(each for each in both if each is not None)
    bins = len(first.counts)
    shares = [[n / each.count for n in each.counts] if each is not None else [0.0] * bins for each in both]
    most, width = max(map(max, shares)) or 1.0, (first.high - first.low) / bins
    return [
        TwinBar(10.0 * at, 60 * a / most, 60 * b / most, first.low + at * width, first.low + (at + 1) * width, (a, b))
        for at, (a, b) in enumerate(zip(*shares, strict=True))
    ]


def _share(value: float, low: float, high: float) -> float:
    return (value - low) / (high - low) if high > low else 0.5
