"""Charts of speed against accuracy, published by `graspd chart`: read, aggregated, drawn as SVG."""

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Final

from pydantic import BaseModel

from graspd.service.model.errors import DamagedError
from graspd.service.model.scene_spec import SceneSpec
from graspd.service.model.studies import FILTERED, pareto_front
from graspd.service.store.records import CHARTS, latest_record, scene_kinds
from graspd.service.store.store import Store

WIDTH: Final = 860
HEIGHT: Final = 420
_LEFT, _RIGHT, _TOP, _BOTTOM = 64, 24, 16, 46
#: Width of a character, height of a line, distance from point to label, radius of the point [px].
_LETTER, _LINE, _AWAY, _DOT = 6.9, 15.0, 12.0, 7.0
#: Vertical offsets of a label from its point, in order of preference [px].
_MOVES: Final = (0.0, 15.0, -15.0, 30.0, -30.0, 45.0, -45.0, 60.0, -60.0)
#: Fidelity of methods that have none; their labels omit it.
_NO_FIDELITY: Final = "as published"


@dataclass(frozen=True)
class Axis:
    label: str
    unit: str = "%"
    more_is_better: bool = True
    factor: float = 100.0
    """Factor on the stored number."""


#: Accuracies of grasps around free objects, and of grasps in scenes; the first of each is the default.
FREE: Final[dict[str, Axis]] = {
    "gsr": Axis("Success in MuJoCo"),
    "dexgraspbench": Axis("Success under the DexGraspBench protocol"),
    "hard": Axis("Success at half the friction"),
    "robust": Axis("Robust share of held grasps"),
    "epsilon": Axis("ε", "", factor=1.0),
    "pd_mm": Axis("Penetration", "mm", more_is_better=False, factor=1.0),
}
IN_SCENES: Final[dict[str, Axis]] = {
    "lift": Axis("Lifted share of candidates"),
    "lift_dexgraspbench": Axis("Lifted under the DexGraspBench protocol"),
    "lift_hard": Axis("Lifted at half the friction"),
    "robust": Axis("Robust share of lifted grasps"),
}


class ChartRun(BaseModel):
    """Run of a method at a fidelity on a hand and object; `way`: how grasps in a scene were made."""

    method: str
    fidelity: str
    hand: str
    object: str
    way: str = ""
    valid_per_second: float | None = None
    end_seconds: list[float] | float | None = None
    kept: int | None = None
    lift_count: int | None = None
    seconds_to_first_valid: float | None = None
    seconds_to_first: float | None = None
    gsr: float | None = None
    dexgraspbench: float | None = None
    hard: float | None = None
    robust: float | None = None
    epsilon: float | None = None
    pd_mm: float | None = None
    lift: float | None = None
    lift_dexgraspbench: float | None = None
    lift_hard: float | None = None

    @property
    def name(self) -> str:
        return f"{self.method}, filtered" if self.way == FILTERED else self.method

    @property
    def label(self) -> str:
        return self.name if self.fidelity == _NO_FIDELITY else f"{self.name} {self.fidelity}"

    @property
    def grasp_count(self) -> int | None:
        """Number of valid grasps, or of lifted grasps in a scene; None in charts of graspd 0.1."""
        return self.kept if self.lift_count is None else self.lift_count

    @property
    def seconds(self) -> float:
        return sum(self.end_seconds) if isinstance(self.end_seconds, list) else self.end_seconds or 0.0

    @property
    def first_valid_s(self) -> float | None:
        return self.seconds_to_first_valid if self.seconds_to_first is None else self.seconds_to_first


class PublishedChart(BaseModel):
    runs: list[ChartRun]
    created: str | None = None
    device: str | None = None
    scene: SceneSpec | None = None

    @property
    def axes(self) -> dict[str, Axis]:
        return IN_SCENES if self.scene else FREE

    @property
    def counted(self) -> str:
        return "lifted" if self.scene else "valid"


@dataclass(frozen=True)
class Point:
    """Result of a method at a fidelity over the selected hands and objects."""

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
    is_left: bool = False
    series: int = 0

    @property
    def label(self) -> tuple[str, str]:
        return self.method, "" if self.fidelity == _NO_FIDELITY else self.fidelity

    def label_box(self, move: float, *, is_left: bool) -> tuple[float, float, float, float]:
        width = _LETTER * len(" ".join(self.label))
        start = self.x - _AWAY - width if is_left else self.x + _AWAY
        return start, self.y + move - _LINE / 2, start + width, self.y + move + _LINE / 2


@dataclass(frozen=True)
class Drawing:
    """Chart: points, front and ticks in SVG coordinates."""

    points: list[Point]
    front: str
    x_ticks: list[tuple[float, str]]
    y_ticks: list[tuple[float, str]]
    axis: Axis
    nothing: list[str]
    """Methods and fidelities without a grasp, which have no speed."""


def load_charts(store: Store) -> list[PublishedChart]:
    """Load the newest published chart of each kind, free objects first, without unreadable charts."""
    found = []
    for kind in (CHARTS, *scene_kinds(store)):
        with suppress(ValueError, DamagedError):
            if (content := latest_record(store, kind)) is not None:
                found.append(PublishedChart.model_validate(content))
    return found


def draw_chart(measured: PublishedChart, *, axis: str, hand: str = "", object: str = "") -> Drawing:
    """Draw every method and fidelity over the runs of a hand and an object; an empty name means all."""
    shown = measured.axes[axis]
    chosen = [run for run in measured.runs if hand in ("", run.hand) and object in ("", run.object)]
    names = sorted({run.name for run in measured.runs})
    groups = [group for group in _groups(chosen) if any(getattr(run, axis) is not None for run in group)]
    points = [point for group in groups if (point := _mean_point(group, axis, shown.factor, names)) is not None]
    points.sort(key=lambda point: point.speed)
    front = pareto_front([(p.speed, p.accuracy if shown.more_is_better else -p.accuracy) for p in points])
    across, x_ticks = _logarithmic_scale([point.speed for point in points])
    up, y_ticks = _linear_scale([point.accuracy for point in points], top=100.0 if shown.unit == "%" else None)
    shown_at = (replace(p, on_front=n in front, x=across(p.speed), y=up(p.accuracy)) for n, p in enumerate(points))
    placed = _place_labels(list(shown_at))
    line = " ".join(f"{point.x:.1f},{point.y:.1f}" for point in placed if point.on_front)
    nothing = [group[0].label for group in _groups(chosen) if not _mean_speed(group)]
    return Drawing(placed, line, x_ticks, y_ticks, shown, nothing)


def _groups(runs: Sequence[ChartRun]) -> list[list[ChartRun]]:
    groups: dict[tuple[str, str], list[ChartRun]] = {}
    for run in runs:
        groups.setdefault((run.name, run.fidelity), []).append(run)
    return list(groups.values())


def _mean_point(runs: list[ChartRun], axis: str, scale: float, names: list[str]) -> Point | None:
    speed = _mean_speed(runs)
    values = [value for run in runs if (value := getattr(run, axis)) is not None]
    firsts = [run.first_valid_s for run in runs if run.first_valid_s is not None]
    if not speed or not values:
        return None
    return Point(
        method=runs[0].name,
        fidelity=runs[0].fidelity,
        pairs=len(runs),
        speed=speed,
        # Pairs without a grasp have no time; a mean over the other pairs would be too favourable.
        first_valid_s=sum(firsts) / len(firsts) if len(firsts) == len(runs) else None,
        accuracy=scale * sum(values) / len(values),
        series=names.index(runs[0].name) % 6,
    )


def _mean_speed(runs: Sequence[ChartRun]) -> float:
    """Return the number of grasps per second of total time.
    In charts of graspd 0.1, it is the geometric mean speed."""
    if all(run.grasp_count is not None for run in runs) and (seconds := sum(run.seconds for run in runs)):
        return sum(run.grasp_count or 0 for run in runs) / seconds
    speeds = [run.valid_per_second for run in runs if run.valid_per_second]
    return math.exp(sum(map(math.log, speeds)) / len(speeds)) if speeds else 0.0


def _place_labels(points: list[Point]) -> list[Point]:
    """Place labels left or right of their points, and up or down, so that they overlap the least."""
    taken = [(p.x - _DOT, p.y - _DOT, p.x + _DOT, p.y + _DOT) for p in points]
    placed: list[Point] = []
    for point in sorted(points, key=lambda point: point.y):
        offers = [(move, is_left) for move in _MOVES for is_left in (False, True)]
        boxes = [point.label_box(move, is_left=is_left) for move, is_left in offers]
        costs = [sum(_overlap_area(box, other) for other in taken) + _outside_cost(box) for box in boxes]
        # The first of equally good places is nearest to the point.
        best = costs.index(min(costs))
        move, is_left = offers[best]
        taken.append(boxes[best])
        placed.append(replace(point, label_y=point.y + move + 4, is_left=is_left))
    return sorted(placed, key=lambda point: point.speed)


def _overlap_area(one: tuple[float, ...], other: tuple[float, ...]) -> float:
    across, up = (max(0.0, min(one[i + 2], other[i + 2]) - max(one[i], other[i])) for i in (0, 1))
    return across * up


def _outside_cost(box: tuple[float, float, float, float]) -> float:
    """Return a cost for a label outside the chart or on its ticks, larger than any overlap."""
    left, top, right, bottom = box
    over = (_LEFT - left, right - (WIDTH - 4), -top, bottom - (HEIGHT - _BOTTOM))
    return 1e4 * sum(max(0.0, part) for part in over)


def _logarithmic_scale(values: Sequence[float]) -> tuple[Callable[[float], float], list[tuple[float, str]]]:
    low, high = (min(values), max(values)) if values else (0.1, 10.0)
    start, end = math.log10(low / 1.6), math.log10(high * 2.4)

    def position(value: float) -> float:
        return _LEFT + (math.log10(value) - start) / (end - start) * (WIDTH - _LEFT - _RIGHT)

    ticks = [m * 10.0**e for e in range(math.floor(start), math.ceil(end) + 1) for m in (1, 2, 5)]
    return position, [(position(tick), f"{tick:g}") for tick in ticks if start <= math.log10(tick) <= end]


def _linear_scale(
    values: Sequence[float], *, top: float | None
) -> tuple[Callable[[float], float], list[tuple[float, str]]]:
    highest = max(values, default=1.0)
    end = top if top is not None else highest * 1.15 or 1.0
    size = 10.0 ** math.floor(math.log10(end / 5))
    step = next(size * m for m in (1, 2, 2.5, 5, 10) if size * m >= end / 5 * 0.999)

    def position(value: float) -> float:
        return HEIGHT - _BOTTOM - value / end * (HEIGHT - _TOP - _BOTTOM)

    return position, [(position(step * i), f"{step * i:g}") for i in range(int(end / step + 1e-9) + 1)]
