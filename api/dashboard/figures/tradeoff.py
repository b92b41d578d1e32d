"""The chart of speed against accuracy that `graspd chart` leaves in the store: read, summed up, drawn as SVG."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

from pydantic import BaseModel, ConfigDict

from service.store.store import Store
from service.store.study_records import latest

WIDTH: Final = 860
HEIGHT: Final = 420
_LEFT, _RIGHT, _TOP, _BOTTOM = 64, 24, 16, 46
#: Room of the longest label.
_LABEL: Final = 190
#: Accuracies to choose from: label, unit, whether more is better, factor from the stored number.
AXES: Final[dict[str, tuple[str, str, bool, float]]] = {
    "gsr": ("Success in MuJoCo", "%", True, 100.0),
    "epsilon": ("ε", "", True, 1.0),
    "pd_mm": ("Penetration", "mm", False, 1.0),
}


class Run(BaseModel):
    """One method at one fidelity on one hand and object."""

    model_config = ConfigDict(extra="ignore")

    method: str
    fidelity: str
    hand: str
    object: str
    valid_per_second: float | None = None
    seconds_to_first_valid: float | None = None
    gsr: float | None = None
    epsilon: float | None = None
    pd_mm: float | None = None


class Measured(BaseModel):
    """What the command left."""

    model_config = ConfigDict(extra="ignore")

    runs: list[Run]
    created: str | None = None
    device: str | None = None


@dataclass(frozen=True)
class Point:
    """A method and fidelity, over the hands and objects chosen."""

    method: str
    fidelity: str
    pairs: int
    speed: float
    first_valid_s: float | None
    accuracy: float
    on_front: bool = False
    x: float = 0.0
    y: float = 0.0
    label_y: float = 0.0
    series: int = 0

    @property
    def is_right(self) -> bool:
        """Whether a label to the right of the point would leave the chart."""
        return self.x > WIDTH - _LABEL


@dataclass(frozen=True)
class Drawing:
    """The chart: points, front, ticks in SVG coordinates."""

    points: list[Point]
    front: str
    x_ticks: list[tuple[float, str]]
    y_ticks: list[tuple[float, str]]
    methods: list[str]
    hands: list[str]
    objects: list[str]


def load(store: Store) -> Measured | None:
    """The chart that was published last; None where there is none that can be read."""
    try:
        found = latest(store, "charts")
        return None if found is None else Measured.model_validate(found)
    except ValueError:
        return None


def draw(measured: Measured, *, axis: str, hand: str = "", object: str = "") -> Drawing:
    """Points of every method and fidelity over the runs of a hand and an object (empty: all of them)."""
    more_is_better, scale = AXES[axis][2], AXES[axis][3]
    chosen = [run for run in measured.runs if hand in ("", run.hand) and object in ("", run.object)]
    methods = sorted({run.method for run in measured.runs})
    points = [point for group in _groups(chosen) if (point := _point(group, axis, scale, methods)) is not None]
    points.sort(key=lambda point: point.speed)
    front = pareto([(point.speed, point.accuracy if more_is_better else -point.accuracy) for point in points])
    across, x_ticks = _logarithmic([point.speed for point in points])
    up, y_ticks = _linear([point.accuracy for point in points], top=100.0 if axis == "gsr" else None)
    placed = _labelled(
        [
            Point(**{**vars(point), "on_front": index in front, "x": across(point.speed), "y": up(point.accuracy)})
            for index, point in enumerate(points)
        ]
    )
    line = " ".join(f"{point.x:.1f},{point.y:.1f}" for point in placed if point.on_front)
    hands, objects = (sorted({getattr(run, name) for run in measured.runs}) for name in ("hand", "object"))
    return Drawing(placed, line, x_ticks, y_ticks, methods, hands, objects)


def pareto(points: Sequence[tuple[float, float]]) -> set[int]:
    """Indices of points (more, more) that no other point beats in both."""
    return {
        index
        for index, (x, y) in enumerate(points)
        if not any((a >= x and b >= y) and (a > x or b > y) for a, b in points)
    }


def _groups(runs: Sequence[Run]) -> list[list[Run]]:
    groups: dict[tuple[str, str], list[Run]] = {}
    for run in runs:
        groups.setdefault((run.method, run.fidelity), []).append(run)
    return list(groups.values())


def _point(runs: list[Run], axis: str, scale: float, methods: list[str]) -> Point | None:
    speeds = [run.valid_per_second for run in runs if run.valid_per_second]
    values = [value for run in runs if (value := getattr(run, axis)) is not None]
    firsts = [run.seconds_to_first_valid for run in runs if run.seconds_to_first_valid is not None]
    if not speeds or not values:
        return None
    # Speeds of easy and hard objects differ by a factor, so their mean is the geometric one.
    speed = math.exp(sum(map(math.log, speeds)) / len(speeds))
    return Point(
        method=runs[0].method,
        fidelity=runs[0].fidelity,
        pairs=len(runs),
        speed=speed,
        first_valid_s=sum(firsts) / len(firsts) if firsts else None,
        accuracy=scale * sum(values) / len(values),
        series=methods.index(runs[0].method) % 6,
    )


def _labelled(points: list[Point]) -> list[Point]:
    """Labels beside their points, pushed down where two would lie on each other."""
    placed: list[Point] = []
    for point in sorted(points, key=lambda point: point.y):
        at = point.y + 4
        for other in placed:
            if abs(other.x - point.x) < 130 and abs(other.label_y - at) < 15:
                at = other.label_y + 15
        placed.append(Point(**{**vars(point), "label_y": at}))
    return sorted(placed, key=lambda point: point.speed)


def _logarithmic(values: Sequence[float]) -> tuple[Callable[[float], float], list[tuple[float, str]]]:
    low, high = (min(values), max(values)) if values else (0.1, 10.0)
    start, end = math.log10(low / 1.6), math.log10(high * 2.4)

    def place(value: float) -> float:
        return _LEFT + (math.log10(value) - start) / (end - start) * (WIDTH - _LEFT - _RIGHT)

    ticks = [m * 10.0**e for e in range(math.floor(start), math.ceil(end) + 1) for m in (1, 2, 5)]
    return place, [(place(tick), f"{tick:g}") for tick in ticks if start <= math.log10(tick) <= end]


def _linear(values: Sequence[float], *, top: float | None) -> tuple[Callable[[float], float], list[tuple[float, str]]]:
    highest = max(values, default=1.0)
    end = top if top is not None else highest * 1.15 or 1.0
    step = _round_step(end / 5)

    def place(value: float) -> float:
        return HEIGHT - _BOTTOM - value / end * (HEIGHT - _TOP - _BOTTOM)

    return place, [(place(step * i), f"{step * i:g}") for i in range(int(end / step + 1e-9) + 1)]


def _round_step(value: float) -> float:
    size: Any = 10.0 ** math.floor(math.log10(value))
    return next(float(size * m) for m in (1, 2, 2.5, 5, 10) if size * m >= value * 0.999)
