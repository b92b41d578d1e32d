"""Grasps: found by their metrics, shown whole, and counted into the distributions of a job."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

from api.access.auth import project_scope
from api.catalog.grasp_files import GraspFiles
from api.models import Diversity, GraspDetail, GraspQuery, Histogram, JobDetail
from service.index.queries.grasps import GraspFilter, GraspSort, Metric
from service.index.queries.statistics import Kinds
from service.index.views import GraspView, JobView, Page
from service.model.diversity import CELLS, GraspType, entropy_bits, evenness
from service.model.errors import LimitError
from service.model.metrics import Indexed, indexed
from service.model.tags import MOST_TAGGED, Grasp
from service.pipeline.backends import Services

_KEPT_HISTOGRAMS: Final = 256
MEAN_METRICS: Final[tuple[Metric, ...]] = tuple(metric.name for metric in indexed(Indexed.OFFERED))


class Grasps:
    """Grasps of the jobs in the caller's scope; they never change."""

    def __init__(self, services: Services) -> None:
        self._index = services.index
        self._files = GraspFiles(services.store)
        self._histograms: dict[tuple[str, int], list[Histogram]] = {}
        self._diversities: dict[tuple[str, int], Diversity | None] = {}

    def page(self, query: GraspQuery, *, limit: int = 50, cursor: str | None = None) -> Page[GraspView]:
        """Grasps that pass every filter."""
        sort = GraspSort(by=query.sort, descending=query.order == "desc")
        return self._index.grasps.page(self._filter(query), sort=sort, limit=limit, cursor=cursor)

    def members(self, query: GraspQuery) -> list[Grasp]:
        """All grasps that pass every filter, by their places.

        Raises:
            LimitError: they are more than are chosen at once.
        """
        found = self._index.grasps.members(self._filter(query), limit=MOST_TAGGED + 1)
        if len(found) > MOST_TAGGED:
            raise LimitError(f"more than {MOST_TAGGED} grasps pass this filter, which is the most at once; narrow it")
        return found

    def listed(self, places: Sequence[Grasp]) -> Iterator[GraspView]:
        """Grasps by their places, which the caller may see; those that are gone are left out."""
        return self._index.grasps.listed(places)

    def _filter(self, query: GraspQuery) -> GraspFilter:
        """The index's filter behind a request's parameters, in the caller's scope.

        Raises:
            NotFoundError: there is no such tag, or dataset.
        """
        seen = project_scope()
        if query.dataset is not None:
            self._index.datasets.get(query.dataset, scope=seen)
        named = {
            "project": None if seen.everything else seen.project,
            "dataset": query.dataset,
            "tag": query.tag and self._index.tags.named(query.tag, scope=seen),
        }
        return _bounded(query).model_copy(update=named)

    def one(self, shard_id: str, row: int) -> GraspDetail:
        """One grasp with all that its shard says of it."""
        grasp, shard = self._index.grasps.get(shard_id, row, scope=project_scope()), self._index.shards.get(shard_id)
        return self._files.detail(grasp, shard)

    def histograms(self, job: JobView | JobDetail, *, bins: int = 20) -> list[Histogram]:
        """Distribution of each metric over a job's valid grasps, or over all that it kept where nobody judged them.

        While their number stays, the answer does.
        """
        judged = job.request.referee != "none"
        key = (job.id, count := job.valid if judged else job.grasps)
        if not count:
            return []
        if (found := self._histograms.get(key)) is None:
            where = GraspFilter(job=job.id, valid=True if judged else None)
            found = [
                Histogram(
                    metric=metric,
                    **vars(summary),
                    counts=self._index.statistics.histogram(where, metric, summary.low, summary.high, bins),
                )
                for metric, summary in self._index.statistics.summaries(where, MEAN_METRICS).items()
            ]
            if len(self._histograms) >= _KEPT_HISTOGRAMS:
                self._histograms.clear()
            self._histograms[key] = found
        return found

    def diversity(self, job: JobView | JobDetail) -> Diversity | None:
        """Types and directions of the grasps whose distributions `histograms` gives."""
        judged = job.request.referee != "none"
        key = (job.id, count := job.valid if judged else job.grasps)
        if not count:
            return None
        if key not in self._diversities:
            if len(self._diversities) >= _KEPT_HISTOGRAMS:
                self._diversities.clear()
            where = GraspFilter(job=job.id, valid=True if judged else None)
            self._diversities[key] = _told(self._index.statistics.kinds(where))
        return self._diversities[key]


def _told(kinds: Kinds) -> Diversity | None:
    if not kinds.cells:
        return None
    return Diversity(
        grasps=sum(kinds.cells.values()),
        types={kind.name.lower(): kinds.types[kind] for kind in GraspType if kinds.types.get(kind)},
        type_entropy_bits=round(entropy_bits(kinds.types.values()), 4),
        directions_used=len(kinds.cells),
        direction_entropy_bits=round(entropy_bits(kinds.cells.values()), 4),
        evenness=round(evenness(kinds.cells.values(), CELLS), 4),
    )


def _bounded(query: GraspQuery) -> GraspFilter:
    """What a request's parameters say of the grasps themselves."""
    bounds: dict[str, dict[Metric, float]] = {"min": {}, "max": {}}
    if query.type is not None:
        kind = float(GraspType[query.type.upper()])
        bounds = {"min": {"grasp_type": kind}, "max": {"grasp_type": kind}}
    for end, metrics in bounds.items():
        for metric in MEAN_METRICS:
            value = getattr(query, f"{end}_{metric}", None)
            if value is not None:
                metrics[metric] = value
    return GraspFilter(
        job=query.job,
        hand=query.hand,
        object=query.object,
        where=query.where,
        valid=query.valid,
        success=query.success,
        scene=query.scene,
        neighbours=query.neighbours,
        lift_hard=query.lift_hard,
        judged=query.judged,
        robust_weakest=query.robust_weakest,
        at_least=bounds["min"],
        at_most=bounds["max"],
    )
