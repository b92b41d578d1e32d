"""How far a dataset is: the numbers of the whole and of each hand x object."""

from __future__ import annotations

from graspd.service.index.index import Index
from graspd.service.index.views import CellView, DatasetView, View

_PAGE = 200


class DatasetStatus(View):
    """A dataset and its cells, hand by hand and in each hand object by object."""

    dataset: DatasetView
    cells: list[CellView]


def status(index: Index, name: str) -> DatasetStatus:
    """All of a dataset: `DatasetView` and one `CellView` for each hand x object, in the order of hands and objects.

    Each cell tells its job, state, grasps asked, made, valid and tried, tasks done and failed, failed attempts and the
    reason of a failure; `cells[i * len(dataset.objects) + j]` is hand i on object j. For a matrix of thousands of cells
    take `index.datasets.cells`, which gives pages and filters by state.

    Raises:
        NotFoundError: unknown dataset.
    """
    cells: list[CellView] = []
    cursor: str | None = None
    while True:
        page = index.datasets.cells(name, limit=_PAGE, cursor=cursor)
        cells += page.items
        cursor = page.next
        if cursor is None:
            return DatasetStatus(dataset=index.datasets.get(name), cells=cells)
