"""Sums over many grasps: means, ranges and distributions of their metrics, counted by the database."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import ColumnElement, Integer, cast, func, select

from service.index.database import Database
from service.index.filters import GraspFilter, Metric
from service.index.grasp_queries import _conditions
from service.index.tables import grasps


@dataclass(frozen=True)
class MetricSummary:
    """One metric over the grasps that have it."""

    count: int
    mean: float
    low: float
    high: float


class Summaries(Database):
    """Reads on all grasps that pass a filter."""

    def summaries(self, where: GraspFilter, metrics: Sequence[Metric]) -> dict[Metric, MetricSummary]:
        """Count, mean and range of each metric; those that no grasp has are left out."""
        columns = [
            function(grasps.c[metric]) for metric in metrics for function in (func.count, func.avg, func.min, func.max)
        ]
        with self.reading() as connection:
            row = connection.execute(select(*columns).where(*_conditions(where))).one()
        parts = {metric: row[4 * i : 4 * i + 4] for i, metric in enumerate(metrics)}
        return {
            metric: MetricSummary(int(count), float(mean), float(low), float(high))
            for metric, (count, mean, low, high) in parts.items()
            if count
        }

    def histogram(self, where: GraspFilter, metric: Metric, low: float, high: float, bins: int) -> list[int]:
        """Number of grasps in each of equal bins of [low, high]; the last one holds its upper end."""
        counts = [0] * bins
        value = grasps.c[metric]
        width = (high - low) / bins
        with self.reading() as connection:
            place: ColumnElement[Any] = (value - low) / width if width > 0 else value * 0
            if connection.dialect.name == "postgresql":
                # Its cast rounds where SQLite's cuts off, and not every SQLite knows floor().
                place = func.floor(place)
            place = cast(place, Integer)
            query = select(place, func.count()).where(value.between(low, high), *_conditions(where)).group_by(place)
            for at, count in connection.execute(query):
                counts[min(int(at), bins - 1)] += int(count)
        return counts
