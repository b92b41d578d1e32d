"""What a study of failure says: a map of cells, where it breaks, how that shows, and what guards against it."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any, Final, Literal

Outcome = Literal["good", "weak", "broken", "refused"]

#: From best to worst; refused stands apart: the guard spoke before anything was computed.
OUTCOMES: Final[tuple[Outcome, ...]] = ("good", "weak", "broken", "refused")


@dataclass(frozen=True)
class Cell:
    """One point of a map."""

    panel: str
    x: float | str
    y: float | str
    value: float
    """The measure, in the map's unit; nan where there is none."""
    outcome: Outcome
    note: str = ""
    label: str = ""
    """What to write on it, where it is not the value."""


@dataclass(frozen=True)
class StabilityMap:
    """One study."""

    name: str
    title: str
    x: str
    y: str
    measure: str
    """What `value` is, with its unit."""
    bounds: str
    """From which value on a cell is weak, and broken."""
    cells: list[Cell]
    shows: str
    """How a user would notice the failure."""
    guard: str
    """What catches it, or that nothing does."""
    guard_test: str = ""
    """The test of the guard."""
    lines: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    """Boundaries that theory gives, to be drawn over the panel of that name."""

    def share(self, panel: str) -> float:
        """Share of a panel's cells that are good."""
        cells = [cell for cell in self.cells if cell.panel == panel]
        return sum(cell.outcome == "good" for cell in cells) / max(1, len(cells))

    @property
    def panels(self) -> list[str]:
        return list(dict.fromkeys(cell.panel for cell in self.cells))

    def as_json(self) -> dict[str, Any]:
        return asdict(self)


def graded(value: float, weak: float, broken: float) -> Outcome:
    """good below `weak`, broken from `broken` on and where the value is no number."""
    if not value < broken:  # nan too
        return "broken"
    return "good" if value < weak else "weak"
