"""Grasps: found by their metrics, shown whole, and counted into the distributions of a job."""

from __future__ import annotations

from typing import Final

from api.catalog.grasp_files import GraspFiles
from api.models import GraspDetail, GraspQuery, Histogram, JobDetail
from service.index.filters import GraspFilter, GraspSort, Metric
from service.index.views import GraspView, JobView, Page
from service.model.metrics import Indexed, indexed
from service.pipeline.backends import Parts

_KEPT_HISTOGRAMS: Final = 256
MEAN_METRICS: Final[tuple[Metric, ...]] = tuple(metric.name for metric in indexed(Indexed.OFFERED))


class Grasps:
    """Grasps of all jobs; they never change."""

    def __init__(self, parts: Parts) -> None:
        self._index = parts.index
        self._files = GraspFiles(parts.store)
        self._histograms: dict[tuple[str, int], list[Histogram]] = {}

    def page(self, query: GraspQuery, *, limit: int = 50, cursor: str | None = None) -> Page[GraspView]:
        """Grasps that pass every filter."""
        sort = GraspSort(by=query.sort, descending=query.order == "desc")
        return self._index.grasps.page(grasp_filter(query), sort=sort, limit=limit, cursor=cursor)

    def one(self, shard_id: str, row: int) -> GraspDetail:
        """One grasp with all that its shard says of it."""
        grasp, shard = self._index.grasps.get(shard_id, row), self._index.shards.get(shard_id)
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


def grasp_filter(query: GraspQuery) -> GraspFilter:
    """The index's filter behind a request's parameters."""
    bounds: dict[str, dict[Metric, float]] = {"min": {}, "max": {}}
    for end, metrics in bounds.items():
        for metric in MEAN_METRICS:
            value = getattr(query, f"{end}_{metric}", None)
            if value is not None:
                metrics[metric] = value
    return GraspFilter(
        job=query.job,
        hand=query.hand,
        object=query.object,
        valid=query.valid,
        success=query.success,
        scene=query.scene,
        neighbours=query.neighbours,
        lift_hard=query.lift_hard,
        pushes_held=query.pushes_held,
        at_least=bounds["min"],
        at_most=bounds["max"],
    )
