"""How far a dataset is: the numbers of the whole and of each hand x object."""

from __future__ import annotations

from typing import NamedTuple

from graspd.service.index.index import Index
from graspd.service.index.views import CellView, DatasetView


class DatasetStatus(NamedTuple):
    """A dataset and its cells, hand by hand and in each hand object by object."""

    dataset: DatasetView
    cells: list[CellView]


def status(index: Index, name: str) -> DatasetStatus:
    page = index.datasets.cells(name, limit=200)
    cells = list(page.items)
    while page.next is not None:
        page = index.datasets.cells(name, limit=200, cursor=page.next)
        cells += page.items
    return DatasetStatus(index.datasets.get(name), cells)
