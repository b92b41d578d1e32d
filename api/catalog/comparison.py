"""Two datasets side by side: what they asked for, what each cell came to, and how good their grasps are."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

from api.catalog.datasets import Datasets
from api.catalog.grasps import MEAN_METRICS
from service.index.queries.grasps import GraspFilter, Metric
from service.index.queries.statistics import Distribution
from service.index.views import CellView, DatasetView
from service.pipeline.backends import Services

#: Cells of a dataset that are compared one by one: nobody reads more rows.
MOST_CELLS: Final = 1000
_AT_ONCE: Final = 200


@dataclass(frozen=True)
class Setting:
    """An option in which they differ, as each has it."""

    name: str
    one: str
    other: str


@dataclass(frozen=True)
class Pair:
    """A hand on an object, and its cell in each; None: that dataset has none."""

    hand: str
    object: str
    one: CellView | None
    other: CellView | None

    @property
    def gain(self) -> float | None:
        """By how much the other's yield is higher, where both have tried."""
        if self.one is None or self.other is None or None in (self.one.valid_yield, self.other.valid_yield):
            return None
        return (self.other.valid_yield or 0.0) - (self.one.valid_yield or 0.0)


@dataclass(frozen=True)
class Comparison:
    """Everything that the page says."""

    one: DatasetView
    other: DatasetView
    settings: list[Setting]
    pairs: list[Pair]
    """Hand by hand; none where a dataset has more than `MOST_CELLS` cells."""
    metrics: dict[Metric, list[Distribution | None]]
    """Of the grasps that each counts, in the same bins."""


class Comparisons:
    """Compares datasets in the caller's scope."""

    def __init__(self, services: Services, datasets: Datasets) -> None:
        self._services = services
        self._datasets = datasets

    def of(self, one: str, other: str) -> Comparison:
        """Two datasets by name.

        Raises:
            NotFoundError: there is no such dataset in scope.
        """
        both = self._datasets.one(one), self._datasets.one(other)
        filters = [
            GraspFilter(dataset=each.name, valid=True if each.options.standing == "valid" else None) for each in both
        ]
        metrics = self._services.index.statistics.side_by_side(filters, MEAN_METRICS)
        few = max(each.cells for each in both) <= MOST_CELLS
        return Comparison(*both, list(_settings(*both)), self._pairs(one, other) if few else [], metrics)

    def _pairs(self, one: str, other: str) -> list[Pair]:
        cells = [{(cell.hand, cell.object): cell for cell in self._cells(name)} for name in (one, other)]
        names = sorted({*cells[0], *cells[1]})
        return [Pair(*name, cells[0].get(name), cells[1].get(name)) for name in names]

    def _cells(self, name: str) -> Iterator[CellView]:
        cursor: str | None = None
        while True:
            page = self._datasets.cells(name, limit=_AT_ONCE, cursor=cursor)
            yield from page.items
            if (cursor := page.next) is None:
                return


def _settings(one: DatasetView, other: DatasetView) -> Iterator[Setting]:
    """Options that differ; then hands and objects that one has and the other has not."""
    said = [each.options.model_dump(mode="json") for each in (one, other)]
    for name in said[0]:
        if said[0][name] != said[1][name]:
            yield Setting(name.replace("_", " "), _text(said[0][name]), _text(said[1][name]))
    for name in ("hands", "objects"):
        first, second = (set(getattr(each, name)) for each in (one, other))
        if first != second:
            yield Setting(f"{name} of its own", _text(sorted(first - second)), _text(sorted(second - first)))


def _text(value: Any) -> str:
    if isinstance(value, list | tuple):
        return ", ".join(map(str, value)) or "–"
    if isinstance(value, dict):
        return ", ".join(f"{name} {_text(one)}" for name, one in value.items()) or "–"
    return "–" if value in (None, "") else str(value)
