"""Aggregates over many grasps: means, ranges and distributions of their metrics, in the database."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import ColumnElement, Connection, Integer, cast, func, select

from graspd.service.index.database import IndexPart
from graspd.service.index.queries.grasps import GraspFilter, Metric, conditions, sql_conditions
from graspd.service.index.tables import dataset_cells, grasps, shards, tasks


@dataclass(frozen=True)
class MetricSummary:
    count: int
    mean: float
    low: float
    high: float


@dataclass(frozen=True)
class GraspKinds:
    """Grasp types, and the cells of the sphere of approaches; grasps without either are omitted."""

    types: dict[int, int]
    """Number of grasps of each `GraspType`."""
    cells: dict[int, int]


class Statistics(IndexPart):
    def summaries(self, where: GraspFilter, metrics: Sequence[Metric]) -> dict[Metric, MetricSummary]:
        """Return count, mean and range of each metric; metrics without any grasp are omitted."""
        columns = [
            function(grasps.c[metric]) for metric in metrics for function in (func.count, func.avg, func.min, func.max)
        ]
        with self.database.reading() as connection:
            row = connection.execute(select(*columns).where(*sql_conditions(where))).one()
        parts = {metric: row[4 * i : 4 * i + 4] for i, metric in enumerate(metrics)}
        return {
            metric: MetricSummary(int(count), float(mean), float(low), float(high))
            for metric, (count, mean, low, high) in parts.items()
            if count
        }

    def histogram(self, where: GraspFilter, metric: Metric, low: float, high: float, bins: int) -> list[int]:
        """Count grasps in equal bins of [low, high]; the last bin includes its upper end."""
        counts = [0] * bins
        value = grasps.c[metric]
        width = (high - low) / bins
        with self.database.reading() as connection:
            place: ColumnElement[Any] = (value - low) / width if width > 0 else value * 0
            if connection.dialect.name == "postgresql":
                # PostgreSQL's cast rounds, SQLite's truncates, and not every SQLite has floor().
                place = func.floor(place)
            place = cast(place, Integer)
            query = select(place, func.count()).where(value.between(low, high), *sql_conditions(where)).group_by(place)
            for at, count in connection.execute(query):
                counts[min(int(at), bins - 1)] += int(count)
        return counts

    def kinds(self, where: GraspFilter, *, at_most: int = 20_000) -> GraspKinds:
        """Return types and directions, from about `at_most` grasps.

        The id of a shard is a digest, so ids below a bound are a fair sample, and they are adjacent in the index.
        """
        columns = grasps.c.grasp_type, grasps.c.approach_cell
        with self.database.reading() as connection:
            query = select(*columns, func.count()).where(*_sampled(connection, where, at_most)).group_by(*columns)
            rows = connection.execute(query).all()
        found = GraspKinds({}, {})
        for kind, cell, count in rows:
            for counts, value in ((found.types, kind), (found.cells, cell)):
                if value is not None:
                    counts[int(value)] = counts.get(int(value), 0) + int(count)
        return found


def _sampled(connection: Connection, where: GraspFilter, at_most: int) -> list[ColumnElement[bool]]:
    """Return the filter restricted to a share of shards with about `at_most` grasps."""
    share = min(1.0, at_most / max(1, _size(connection, where)))
    tests = [c.sql(["shard", "job", "dataset"]) for c in conditions(where)]
    return [*tests, grasps.c.shard_id < f"{round(share * 16**8):08x}"] if share < 1.0 else tests


def _size(connection: Connection, where: GraspFilter) -> int:
    """Return the number of grasps of the filter's shard, job or pair, or of all."""
    query = select(func.sum(shards.c.count)).where(shards.c.kind == "base")
    if where.shard is not None:
        query = query.where(shards.c.id == where.shard)
    elif where.job is not None:
        query = select(func.sum(tasks.c.count)).where(tasks.c.job_id == where.job, tasks.c.position == 0)
    elif where.dataset is not None:
        cells = (dataset_cells.c.job_id == tasks.c.job_id, dataset_cells.c.dataset == where.dataset)
        query = select(func.sum(tasks.c.count)).where(*cells, tasks.c.position == 0)
    else:
        pair = {"hand": where.hand, "object": where.object}
        query = query.where(*(shards.c[name] == value for name, value in pair.items() if value is not None))
    return int(connection.scalar(query) or 0)
