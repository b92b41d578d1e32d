"""The hand x object matrix as the pages show it: a cell's state, its yield as number and colour."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

from service.index.views import CellView, DatasetView, MatrixCell
from service.model.states import State

#: Steps of the colour scale; the style sheet has a class for each.
STEPS: Final = 10
#: More objects than this are too long a page; those with work come first.
_ROWS: Final = 60


@dataclass(frozen=True)
class Tile:
    """One hand on one object. `made` counts grasps of its `standing`; `share` is the valid part of the judged; `value`
    is what its checkbox sends, `href` where it leads."""

    hand: str
    object: str
    value: str
    href: str
    state: str
    made: int
    tried: int
    share: float | None
    standing: str = "valid"
    jobs: int = 0
    progress: float | None = None
    note: str = ""
    scene: str = "free"
    """Kind of the scene in which its grasps are valid."""

    @property
    def shade(self) -> str:
        """Class of the cell's colour: by yield, or none while there is nothing to judge."""
        return "none" if self.share is None else f"y{min(STEPS, int(STEPS * self.share + 0.5))}"


@dataclass(frozen=True)
class Grid:
    """Rows are objects, columns are hands."""

    hands: list[str]
    rows: list[tuple[str, list[Tile | None]]]
    hidden: int = 0


def of_dataset(dataset: DatasetView, cells: Sequence[CellView]) -> Grid:
    """The matrix of a dataset."""
    found = {
        (cell.hand, cell.object): Tile(
            hand=cell.hand,
            object=cell.object,
            value=cell.job_id,
            href=f"/jobs/{cell.job_id}" if cell.planned else "",
            state=cell.state.value,
            made=cell.counted(dataset.options),
            tried=cell.tried,
            share=cell.valid_yield,
            standing=dataset.options.standing,
            progress=cell.progress if cell.state is State.RUNNING else None,
            note=cell.reason or "",
            scene=dataset.options.place.kind,
        )
        for cell in cells
    }
    return _grid(dataset.hands, dataset.objects, found)


def of_service(cells: Iterable[MatrixCell], hands: Sequence[str], objects: Sequence[str]) -> Grid:
    """The matrix of everything: all known hands and objects, with what their jobs came to."""
    found = {
        (cell.hand, cell.object): Tile(
            hand=cell.hand,
            object=cell.object,
            value=f"{cell.hand}|{cell.object}",
            href=f"/grasps?hand={cell.hand}&object={cell.object}",
            state=_state(cell),
            made=cell.valid if cell.judged else cell.grasps,
            tried=cell.tried,
            share=cell.valid_yield,
            standing="valid" if cell.judged else "kept",
            jobs=cell.jobs,
        )
        for cell in cells
    }
    columns = list(dict.fromkeys([*hands, *(hand for hand, _ in found)]))
    names = list(dict.fromkeys([*objects, *(obj for _, obj in found)]))
    worked = {obj for _, obj in found}
    ordered = sorted(names, key=lambda name: (name not in worked, name))
    for hand in columns:
        for obj in ordered[:_ROWS]:
            found.setdefault((hand, obj), Tile(hand, obj, f"{hand}|{obj}", "", "blank", 0, 0, None))
    return _grid(columns, ordered[:_ROWS], found, hidden=max(0, len(ordered) - _ROWS))


def _grid(hands: Sequence[str], objects: Sequence[str], found: dict[tuple[str, str], Tile], hidden: int = 0) -> Grid:
    return Grid(list(hands), [(obj, [found.get((hand, obj)) for hand in hands]) for obj in objects], hidden)


def _state(cell: MatrixCell) -> str:
    if cell.running:
        return State.RUNNING.value
    if cell.queued:
        return State.QUEUED.value
    return State.FAILED.value if cell.failed else State.SUCCEEDED.value
