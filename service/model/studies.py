"""Records of studies: stability maps; names of accuracies and speeds in charts."""

import math
from bisect import bisect_right
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Annotated, Any, Final, Literal

from pydantic import BeforeValidator, TypeAdapter

from graspd.service.model.base import json_value

Outcome = Literal["good", "weak", "broken", "refused"]

#: Outcomes from best to worst. `refused`: a check rejected the input before the computation.
OUTCOMES: Final[tuple[Outcome, ...]] = ("good", "weak", "broken", "refused")
_Number = Annotated[float, BeforeValidator(lambda value: math.nan if value is None else value)]


@dataclass(frozen=True)
class MapCell:
    panel: str
    x: float | str
    y: float | str
    value: _Number
    outcome: Outcome
    note: str = ""
    label: str = ""
    reached: bool = False
    """Whether any job can reach this point."""

    @property
    def text(self) -> str:
        return self.label or format_short(self.value)


@dataclass(frozen=True)
class StabilityMap:
    name: str
    title: str
    x: str
    y: str
    measure: str
    bounds: str
    """Thresholds of weak and broken cells."""
    cells: list[MapCell]
    shows: str
    """Symptoms of the failure for a user."""
    guard: str
    guard_test: str = ""
    lines: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    """Theoretical boundaries to draw over each panel, by its name."""
    reach: str = ""
    """Which cells a job can reach, with the reason."""

    def good_share(self, panel: str) -> float:
        cells = self.panel_cells(panel)
        return sum(cell.outcome == "good" for cell in cells) / max(1, len(cells))

    @property
    def panels(self) -> list[str]:
        return list(dict.fromkeys(cell.panel for cell in self.cells))

    def panel_cells(self, panel: str) -> list[MapCell]:
        return [cell for cell in self.cells if cell.panel == panel]

    def reached(self) -> list[MapCell]:
        return [cell for cell in self.cells if cell.reached]

    @property
    def is_partly_reachable(self) -> bool:
        """Whether jobs can reach some cells, but not all."""
        return 0 < len(self.reached()) < len(self.cells)

    def broken_cell_lines(self) -> list[str]:
        """Return a line per panel with broken cells that jobs can reach: `PANEL X, X (Y, Y); ...`."""
        lines = []
        for panel in self.panels:
            by_x: dict[float | str, list[str]] = defaultdict(list)
            for cell in self.panel_cells(panel):
                if cell.reached and cell.outcome == "broken":
                    by_x[cell.x].append(format_tick(cell.y))
            by_y: dict[str, list[str]] = defaultdict(list)
            for x, ys in by_x.items():
                by_y[", ".join(ys)].append(format_tick(x))
            if by_y:
                lines.append(f"{panel} " + "; ".join(f"{', '.join(xs)} ({ys})" for ys, xs in by_y.items()))
        return lines


@dataclass(frozen=True)
class Stability:
    created: str
    command: str
    versions: dict[str, str]
    maps: list[StabilityMap]

    def as_json(self) -> dict[str, Any]:
        """Return a JSON object; None replaces nan and infinity, and `parse_stability` reads None as nan."""
        return dict(json_value(asdict(self)))


def parse_stability(record: Mapping[str, Any]) -> Stability:
    """Read a record of `as_json`; ValueError if it is invalid."""
    return _RECORD.validate_python(record)


def pareto_front(points: Sequence[tuple[float, float]]) -> set[int]:
    """Return indices of points that no other point dominates; more is better in both coordinates."""
    return {i for i, (x, y) in enumerate(points) if not any(a >= x and b >= y and (a, b) != (x, y) for a, b in points)}


def count_outcomes(cells: Iterable[MapCell]) -> dict[Outcome, int]:
    outcomes = [cell.outcome for cell in cells]
    return {outcome: outcomes.count(outcome) for outcome in OUTCOMES}


def mark_reachable(cells: Iterable[MapCell], where: Callable[[MapCell], bool]) -> list[MapCell]:
    return [replace(cell, reached=where(cell)) for cell in cells]


def format_short(value: float) -> str:
    """Format a number in at most five characters, for a small cell."""
    size = abs(value)
    if not math.isfinite(value):
        return "" if math.isnan(value) else "∞"
    if size == 0 or 0.005 <= size < 999.5:
        return f"{value:.2f}" if 0 < size < 1 else f"{value:.1f}" if 1 <= size < 9.95 else f"{value:.0f}"
    return f"{value / 1e3:.0f}k" if 999.5 <= size < 999_500 else _exponent(f"{value:.0e}")


def format_tick(value: float | str) -> str:
    if isinstance(value, str):
        return value
    return f"{value:g}" if value == 0 or 1e-3 <= abs(value) < 1e4 else _exponent(f"{value:g}")


def tick_position(ticks: Sequence[Any], value: float) -> float:
    """Return a value's position on logarithmic ticks, in steps from the first; extrapolate beyond them."""
    logs, at = [math.log(tick) for tick in ticks], math.log(value)
    if len(logs) < 2:
        return 0.0
    k = min(max(bisect_right(logs, at) - 1, 0), len(logs) - 2)
    return k + (at - logs[k]) / (logs[k + 1] - logs[k])


def _exponent(text: str) -> str:
    """Shorten an exponent (1e-05 to 1e-5); for a number without an exponent, write one if it is shorter."""
    mantissa, exponent = (text if "e" in text else f"{float(text):e}").split("e")
    if "e" not in text:
        return min(text, f"{mantissa.rstrip('0').rstrip('.')}e{int(exponent)}", key=len)
    return f"{mantissa}e{int(exponent)}"


_RECORD: Final = TypeAdapter(Stability)

#: Modes of rows in charts of scenes: planned in the scene, or planned around a free object and filtered.
IN_SCENE: Final = "in the scene"
FILTERED: Final = "free, filtered"

#: Accuracies of targets, with a flag for "more is better": for free objects, and in scenes.
FREE: Final = {"gsr": True, "dexgraspbench": True, "hard": True, "robust": True, "epsilon": True, "pd_mm": False}
IN_SCENES: Final = {"lift": True, "lift_dexgraspbench": True, "lift_hard": True, "robust": True}

#: Speeds: end to end, and of the planner alone; charts of graspd 0.1 have only the speed of the planner.
SPEEDS: Final = ("end_to_end_per_second", "valid_per_second")
