"""Records of studies: maps of failure, and the words of charts of speed against accuracy.

`graspd stability` makes the maps and publishes them; the report and the dashboard draw them from the same record.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Annotated, Any, Final, Literal

from pydantic import BeforeValidator, TypeAdapter

Outcome = Literal["good", "weak", "broken", "refused"]

#: From best to worst; refused stands apart: the guard spoke before anything was computed.
OUTCOMES: Final[tuple[Outcome, ...]] = ("good", "weak", "broken", "refused")
#: JSON knows no nan.
_Number = Annotated[float, BeforeValidator(lambda value: math.nan if value is None else value)]


@dataclass(frozen=True)
class MapCell:
    """One point of a map."""

    panel: str
    x: float | str
    y: float | str
    value: _Number
    """The measure, in the map's unit; nan where there is none."""
    outcome: Outcome
    note: str = ""
    """The value in words, or why there is none."""
    label: str = ""
    """What to write on it, where it is not the value: a few letters."""
    reached: bool = False
    """Whether a job can come here, whatever it asks for."""

    @property
    def text(self) -> str:
        return self.label or short(self.value)


@dataclass(frozen=True)
class StabilityMap:
    """One study."""

    name: str
    title: str
    x: str
    """Name of the horizontal axis with its unit."""
    y: str
    measure: str
    """What stands on a cell, with its unit."""
    bounds: str
    """From which value on a cell is weak, and broken."""
    cells: list[MapCell]
    shows: str
    """How a user would notice the failure."""
    guard: str
    """What catches it, or that nothing does."""
    guard_test: str = ""
    """The test of the guard."""
    lines: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    """Boundaries that theory gives, to be drawn over the panel of that name."""
    reach: str = ""
    """Which cells a job can come to, and why no others."""

    def share(self, panel: str) -> float:
        """Share of a panel's cells that are good."""
        cells = self.of(panel)
        return sum(cell.outcome == "good" for cell in cells) / max(1, len(cells))

    @property
    def panels(self) -> list[str]:
        return list(dict.fromkeys(cell.panel for cell in self.cells))

    def of(self, panel: str) -> list[MapCell]:
        return [cell for cell in self.cells if cell.panel == panel]

    def reached(self) -> list[MapCell]:
        """Cells that a job can come to."""
        return [cell for cell in self.cells if cell.reached]

    @property
    def is_divided(self) -> bool:
        """Whether some cells are within reach of a job and some are not."""
        return 0 < len(self.reached()) < len(self.cells)

    def still_breaks(self) -> list[str]:
        """Broken cells that a job can come to, a line for each panel: no guard keeps jobs from there."""
        lines = []
        for panel in self.panels:
            by_x: dict[float | str, list[str]] = {}
            for cell in self.of(panel):
                if cell.reached and cell.outcome == "broken":
                    by_x.setdefault(cell.x, []).append(tick(cell.y))
            by_y: dict[str, list[str]] = {}
            for x, ys in by_x.items():
                by_y.setdefault(", ".join(ys), []).append(tick(x))
            if by_y:
                lines.append(f"{panel} " + "; ".join(f"{', '.join(xs)} ({ys})" for ys, xs in by_y.items()))
        return lines


@dataclass(frozen=True)
class Stability:
    """All maps of one run of the command."""

    created: str
    command: str
    versions: dict[str, str]
    maps: list[StabilityMap]

    def as_json(self) -> dict[str, Any]:
        """Numbers that JSON does not know become None; `from_json` reads them as nan."""
        return dict(_plain(asdict(self)))


def from_json(record: Mapping[str, Any]) -> Stability:
    """What `as_json` gave.

    Raises:
        ValueError: it is no such record.
    """
    return _RECORD.validate_python(record)


def counts(cells: Iterable[MapCell]) -> dict[Outcome, int]:
    """How many cells came out how."""
    outcomes = [cell.outcome for cell in cells]
    return {outcome: outcomes.count(outcome) for outcome in OUTCOMES}


def graded(value: float, weak: float, broken: float) -> Outcome:
    """good below `weak`, broken from `broken` on and where the value is no number."""
    if not value < broken:  # nan too
        return "broken"
    return "good" if value < weak else "weak"


def reachable(cells: Iterable[MapCell], where: Callable[[MapCell], bool]) -> list[MapCell]:
    """The cells, marked where a job can come."""
    return [replace(cell, reached=where(cell)) for cell in cells]


def short(value: float) -> str:
    """A number in at most five letters: it has to stand in a small square."""
    size = abs(value)
    if not math.isfinite(value):
        return "" if math.isnan(value) else "∞"
    if size == 0 or 0.005 <= size < 999.5:
        return f"{value:.2f}" if 0 < size < 1 else f"{value:.1f}" if 1 <= size < 9.95 else f"{value:.0f}"
    return f"{value / 1e3:.0f}k" if 999.5 <= size < 999_500 else _exponent(f"{value:.0e}")


def tick(value: float | str) -> str:
    """A value of an axis, as short as it goes without loss."""
    if isinstance(value, str):
        return value
    return f"{value:g}" if value == 0 or 1e-3 <= abs(value) < 1e4 else _exponent(f"{value:g}")


def between(ticks: Sequence[Any], value: float) -> float:
    """Where a value lies among logarithmic ticks, in steps from the first; beyond their ends too."""
    logs, at = [math.log(tick) for tick in ticks], math.log(value)
    if len(logs) < 2:
        return 0.0
    k = min(max(bisect_right(logs, at) - 1, 0), len(logs) - 2)
    return k + (at - logs[k]) / (logs[k + 1] - logs[k])


def _exponent(text: str) -> str:
    """1e-05 as 1e-5; numbers that `:g` writes without an exponent are given one where it is shorter."""
    if "e" not in text:
        digits = f"{float(text):e}".split("e")
        shorter = f"{digits[0].rstrip('0').rstrip('.')}e{int(digits[1])}"
        return min(text, shorter, key=len)
    mantissa, exponent = text.split("e")
    return f"{mantissa}e{int(exponent)}"


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


_RECORD: Final = TypeAdapter(Stability)

#: Ways of a row of a chart in scenes: planned for the scene, or around a free object and put there afterwards.
IN_SCENE: Final = "in the scene"
FILTERED: Final = "free, filtered"

#: Accuracies that a target may name, and whether more is better: of grasps around a free object, and in scenes.
FREE: Final = {"gsr": True, "dexgraspbench": True, "hard": True, "robust": True, "epsilon": True, "pd_mm": False}
IN_SCENES: Final = {"lift": True, "lift_dexgraspbench": True, "lift_hard": True, "robust": True}

#: Speeds, end to end before the planner's own, which is all that charts of graspd 0.1 have.
SPEEDS: Final = ("end_to_end_per_second", "valid_per_second")
