"""Figures of the pages: the hand x object matrix, and maps of failure."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

from graspd.service.index.views import CellView, DatasetView, MatrixCell
from graspd.service.model import studies
from graspd.service.model.errors import DamagedError
from graspd.service.model.states import State
from graspd.service.store.records import STABILITY, latest_record
from graspd.service.store.store import Store

#: Steps of the colour scale; the style sheet has a class for each.
STEPS: Final = 10
#: Maximum number of objects on a page; objects with jobs come first.
_ROWS: Final = 60


@dataclass(frozen=True)
class Tile:
    """Cell of the matrix: one hand on one object.

    `made`: number of grasps of kind `standing`; `share`: yield; `value`: value of the checkbox.
    """

    hand: str
    object: str
    value: str
    href: str
    state: str
    made: int
    candidates: int
    share: float | None
    standing: str = "valid"
    jobs: int = 0
    progress: float | None = None
    note: str = ""
    scene: str = "free"

    @property
    def shade(self) -> str:
        """CSS class of the cell's colour, by yield; `none` if no grasp is validated."""
        return "none" if self.share is None else f"y{min(STEPS, int(STEPS * self.share + 0.5))}"


@dataclass(frozen=True)
class Grid:
    hands: list[str]
    rows: list[tuple[str, list[Tile | None]]]
    hidden: int = 0


def dataset_grid(dataset: DatasetView, cells: Sequence[CellView]) -> Grid:
    found = {
        (cell.hand, cell.object): Tile(
            hand=cell.hand,
            object=cell.object,
            value=cell.job_id,
            href=f"/jobs/{cell.job_id}" if cell.planned else "",
            state=cell.state.value,
            made=cell.counted_grasps(dataset.options),
            candidates=cell.candidates,
            share=cell.valid_yield,
            standing=dataset.options.displayed_status,
            progress=cell.progress if cell.state is State.RUNNING else None,
            note=cell.reason or "",
            scene=dataset.options.scene_spec.kind,
        )
        for cell in cells
    }
    return _grid(dataset.hands, dataset.objects, found)


def service_grid(cells: Iterable[MatrixCell], hands: Sequence[str], objects: Sequence[str]) -> Grid:
    """Return the matrix of all jobs, with a blank tile for each pair without a job."""
    found = {
        (cell.hand, cell.object): Tile(
            hand=cell.hand,
            object=cell.object,
            value=f"{cell.hand}|{cell.object}",
            href=f"/grasps?hand={cell.hand}&object={cell.object}",
            state=next((name for name in ("running", "queued", "failed") if getattr(cell, name)), "succeeded"),
            made=cell.valid if cell.validated else cell.grasps,
            candidates=cell.candidates,
            share=cell.valid_yield,
            standing="valid" if cell.validated else "kept",
            jobs=cell.jobs,
        )
        for cell in cells
    }
    columns = list(dict.fromkeys([*hands, *(hand for hand, _ in found)]))
    worked = {obj for _, obj in found}
    ordered = sorted({*objects, *worked}, key=lambda name: (name not in worked, name))
    for hand in columns:
        for obj in ordered[:_ROWS]:
            found.setdefault((hand, obj), Tile(hand, obj, f"{hand}|{obj}", "", "blank", 0, 0, None))
    return _grid(columns, ordered[:_ROWS], found, hidden=max(0, len(ordered) - _ROWS))


def _grid(hands: Sequence[str], objects: Sequence[str], found: dict[tuple[str, str], Tile], hidden: int = 0) -> Grid:
    return Grid(list(hands), [(obj, [found.get((hand, obj)) for hand in hands]) for obj in objects], hidden)


#: Width and height of a cell with its gap [px], as in the style sheet.
PITCH: Final = (40, 30)


@dataclass(frozen=True)
class Panel:
    """Panel of one method or family: rows from the top, columns from the left."""

    name: str
    x: str
    y: str
    columns: list[str]
    rows: list[tuple[str, list[studies.MapCell | None]]]
    line: str
    """Points of the theoretical boundary, over the cells."""


def load_stability(store: Store) -> studies.Stability | None:
    """Load the newest published stability maps; None if there are none, or they are unreadable."""
    try:
        found = latest_record(store, STABILITY)
        return None if found is None else studies.parse_stability(found)
    except (ValueError, DamagedError):
        return None


def draw_panel(one: studies.StabilityMap, name: str) -> Panel:
    cells = one.panel_cells(name)
    xs, ys = ([*dict.fromkeys(getattr(cell, axis) for cell in cells)] for axis in ("x", "y"))
    squares = {(cell.x, cell.y): cell for cell in cells}
    line = one.lines.get(name, [])
    if any(isinstance(x, str) for x in xs):
        # Texts are labels of rows, because columns are narrow.
        rows = [(studies.format_tick(x), [squares.get((x, y)) for y in ys]) for x in xs]
        return Panel(name, one.y, one.x, [studies.format_tick(y) for y in ys], rows, "")
    upward = ys if all(isinstance(y, str) for y in ys) else ys[::-1]
    rows = [(studies.format_tick(y), [squares.get((x, y)) for x in xs]) for y in upward]
    points = " ".join(
        f"{PITCH[0] * (at_x + 0.5):.1f},{PITCH[1] * (len(ys) - 0.5 - at_y):.1f}"
        for at_x, at_y in ((studies.tick_position(xs, x), studies.tick_position(ys, y)) for x, y in line)
    )
    return Panel(name, one.x, one.y, [studies.format_tick(x) for x in xs], rows, points)
