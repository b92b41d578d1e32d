"""The maps of failure that `graspd stability` leaves in the store: read, and laid out as tables of coloured cells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from service.model.errors import DamagedError
from service.model.studies import OUTCOMES, MapCell, Outcome, Stability, StabilityMap, between, counts, from_json, tick
from service.store.records import STABILITY, latest
from service.store.store import Store

#: Width and height of a cell with its gap, as the style sheet has them [px]: lines are drawn over the cells.
PITCH: Final = (40, 30)


@dataclass(frozen=True)
class Square:
    """A cell as it is drawn."""

    outcome: Outcome
    text: str
    said: str
    """All about it in one line, for whoever points at it."""
    ringed: bool


@dataclass(frozen=True)
class Panel:
    """One method or family: rows from the top down, columns from the left."""

    name: str
    x: str
    y: str
    columns: list[str]
    rows: list[tuple[str, list[Square | None]]]
    line: str
    """Points of the boundary that theory gives, over the cells."""

    @property
    def width(self) -> int:
        return PITCH[0] * len(self.columns)

    @property
    def height(self) -> int:
        return PITCH[1] * len(self.rows)


@dataclass(frozen=True)
class Share:
    """A part of a bar that is 100 wide."""

    outcome: Outcome
    count: int
    x: float
    width: float


@dataclass(frozen=True)
class Drawn:
    """One map with what is said beneath it."""

    map: StabilityMap
    panels: list[Panel]
    counts: dict[Outcome, int]
    reached: list[Share]
    still_breaks: list[str]


def load(store: Store) -> Stability | None:
    """The maps that were published last; None where there are none that can be read."""
    try:
        found = latest(store, STABILITY)
        return None if found is None else from_json(found)
    except (ValueError, DamagedError):
        return None


def draw(one: StabilityMap) -> Drawn:
    """A map as panels and numbers."""
    return Drawn(
        map=one,
        panels=[_panel(one, name) for name in one.panels],
        counts={outcome: number for outcome, number in counts(one.cells).items() if number},
        reached=_shares(one.reached()),
        still_breaks=one.still_breaks(),
    )


def _panel(one: StabilityMap, name: str) -> Panel:
    cells = one.of(name)
    xs, ys = ([*dict.fromkeys(getattr(cell, axis) for cell in cells)] for axis in ("x", "y"))
    squares = {(cell.x, cell.y): _square(one, cell, ringed=one.is_divided and cell.reached) for cell in cells}
    line = one.lines.get(name, [])
    if any(isinstance(x, str) for x in xs):
        # Words stand better before a row than under a narrow column.
        rows = [(tick(x), [squares.get((x, y)) for y in ys]) for x in xs]
        return Panel(name, one.y, one.x, [tick(y) for y in ys], rows, "")
    upward = ys if all(isinstance(y, str) for y in ys) else ys[::-1]
    rows = [(tick(y), [squares.get((x, y)) for x in xs]) for y in upward]
    points = " ".join(
        f"{PITCH[0] * (between(xs, x) + 0.5):.1f},{PITCH[1] * (len(ys) - 0.5 - between(ys, y)):.1f}" for x, y in line
    )
    return Panel(name, one.x, one.y, [tick(x) for x in xs], rows, points)


def _square(one: StabilityMap, cell: MapCell, *, ringed: bool) -> Square:
    value = cell.note or (f"{cell.value:.3g}" if cell.value == cell.value else "no value")
    return Square(
        outcome=cell.outcome,
        text=cell.text,
        said=f"{one.x} {tick(cell.x)}, {one.y} {tick(cell.y)}: {cell.outcome}; {value}",
        ringed=ringed,
    )


def _shares(cells: Sequence[MapCell]) -> list[Share]:
    found = counts(cells)
    shares, x = [], 0.0
    for outcome in OUTCOMES:
        if found[outcome]:
            width = 100.0 * found[outcome] / len(cells)
            shares.append(Share(outcome, found[outcome], x, width))
            x += width
    return shares
