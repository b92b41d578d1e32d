"""Datasets, named sets of objects, and comparison of two datasets.

Until it ends, a dataset counts against its key's quota as one job with all its grasps.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

from graspd.api.access.auth import InScope, caller, caller_id, project_scope, require_ownership
from graspd.api.access.quotas import DATASET_PREFIX, Quotas
from graspd.api.catalog.grasps import MEAN_METRICS
from graspd.service.index.queries.grasps import GraspFilter, Metric
from graspd.service.index.queries.statistics import Distribution
from graspd.service.index.views import CellView, DatasetView, ObjectSetView
from graspd.service.model.records import Snapshot
from graspd.service.model.states import State
from graspd.service.pipeline import deletion
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.datasets import actions
from graspd.service.pipeline.datasets.cost import estimate
from graspd.service.pipeline.datasets.spec import DatasetRequest, Estimate, Matrix
from graspd.service.pipeline.fidelity_choice import FidelityResolver
from graspd.service.store.records import load_snapshot

log = logging.getLogger(__name__)


class Datasets:
    """Datasets in the caller's scope; changes can raise ForeignResource (another owner) and QuotaError."""

    def __init__(self, services: Services, quotas: Quotas) -> None:
        self._services = services
        self._quotas = quotas

    def create(self, request: DatasetRequest) -> DatasetView:
        hands, objects = actions.resolve_members(self._services, request, project_scope())
        asked = len(hands) * len(objects) * request.grasps
        with self._quotas.claim(caller.get(), DATASET_PREFIX + request.name, asked) as claim:
            dataset, claim.counts = actions.create(self._services, request, owner=caller_id(), scope=project_scope())
        return dataset

    def cancel(self, name: str) -> DatasetView:
        self._get_owned(name)
        return actions.cancel(self._services, name)

    def retry(self, name: str) -> DatasetView:
        """Restart a dataset; restarted cells count against the quota."""
        dataset = self._get_owned(name)
        again = dataset.states[State.FAILED] + dataset.states[State.CANCELLED]
        grasps = again * dataset.options.grasps
        with self._quotas.claim(caller.get(), DATASET_PREFIX + name, grasps, is_new=False):
            return actions.retry(self._services, name)

    def delete(self, name: str, *, with_snapshots: bool = False) -> None:
        """Delete an ended dataset; one with snapshots requires `with_snapshots`."""
        self._get_owned(name)
        deletion.delete_dataset(self._services, name, owner=caller_id(), with_snapshots=with_snapshots)
        log.info("dataset %s deleted", name)

    def estimate(self, matrix: Matrix) -> Estimate:
        return estimate(self._services.index, matrix, FidelityResolver(self._services.store), scope=project_scope())

    page = InScope(lambda index: index.datasets.page)
    get = InScope(lambda index: index.datasets.get)
    cells = InScope(lambda index: index.datasets.cells)
    matrix = InScope(lambda index: index.overview.matrix)
    snapshots = InScope(lambda index: index.datasets.snapshots)
    object_sets = InScope(lambda index: index.object_sets.newest_versions)
    object_set = InScope(lambda index: index.object_sets.get)

    def take_snapshot(self, name: str) -> tuple[Snapshot, bool]:
        """Record the dataset's present shards; return the snapshot, and whether it is new."""
        self.get(name)
        return actions.take_snapshot(self._services, name)

    def snapshot(self, name: str, digest: str) -> Snapshot:
        self.get(name)
        return load_snapshot(self._services.store, name, digest)

    def add_object_set(self, name: str, objects: tuple[str, ...]) -> ObjectSetView:
        """Name a set of objects; other objects under the same name become its next version."""
        return actions.add_object_set(
            self._services,
            name,
            objects,
            owner=caller_id(),
            scope=project_scope(),
            may_follow=lambda owner, project: require_ownership(owner, f"the set {name!r}", project),
        )

    def compare(self, one: str, other: str) -> Comparison:
        both = self.get(one), self.get(other)
        filters = [
            GraspFilter(dataset=each.name, valid=each.options.displayed_status == "valid" or None) for each in both
        ]
        metrics = self._services.index.statistics.compare_distributions(filters, MEAN_METRICS)
        few = max(each.cells for each in both) <= MOST_CELLS
        return Comparison(*both, list(_differing_settings(*both)), self._cell_pairs(one, other) if few else [], metrics)

    def _cell_pairs(self, one: str, other: str) -> list[CellPair]:
        pages = [self.cells(name, limit=MOST_CELLS) for name in (one, other)]
        cells = [{(cell.hand, cell.object): cell for cell in page.items} for page in pages]
        names = sorted({*cells[0], *cells[1]})
        return [CellPair(*name, cells[0].get(name), cells[1].get(name)) for name in names]

    def _get_owned(self, name: str) -> DatasetView:
        dataset = self.get(name)
        require_ownership(dataset.owner, f"dataset {name!r}", dataset.project)
        return dataset


#: Most cells that one table shows; a longer one would be unreadable.
MOST_CELLS: Final = 1000


@dataclass(frozen=True)
class CellPair:
    """Hand and object with their cell in each dataset; None if a dataset has no such cell."""

    hand: str
    object: str
    one: CellView | None
    other: CellView | None

    @property
    def gain(self) -> float | None:
        """Yield of the other dataset minus yield of this one, if both have candidates."""
        before, after = (None if cell is None else cell.valid_yield for cell in (self.one, self.other))
        return None if before is None or after is None else after - before


@dataclass(frozen=True)
class Comparison:
    one: DatasetView
    other: DatasetView
    settings: list[tuple[str, str, str]]
    """Options that differ, with both values."""
    pairs: list[CellPair]
    """Ordered by hand; empty if a dataset has more than `MOST_CELLS` cells."""
    metrics: dict[Metric, list[Distribution | None]]
    """Distributions of both datasets in the same bins, each over its valid grasps if it requests these, else all."""


def _differing_settings(one: DatasetView, other: DatasetView) -> Iterator[tuple[str, str, str]]:
    """Yield options that differ, with both values; then hands and objects that only one dataset has."""
    said = [each.options.model_dump(mode="json") for each in (one, other)]
    for name in said[0]:
        if said[0][name] != said[1][name]:
            yield name.replace("_", " "), _setting_text(said[0][name]), _setting_text(said[1][name])
    for name in ("hands", "objects"):
        first, second = (set(getattr(each, name)) for each in (one, other))
        if first != second:
            yield f"{name} of its own", _setting_text(sorted(first - second)), _setting_text(sorted(second - first))


def _setting_text(value: Any) -> str:
    if isinstance(value, list | tuple):
        return ", ".join(map(str, value)) or "–"
    if isinstance(value, dict):
        return ", ".join(f"{name} {_setting_text(one)}" for name, one in value.items()) or "–"
    return "–" if value in (None, "") else str(value)
