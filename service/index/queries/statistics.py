"""Aggregates over many grasps: means, ranges and distributions of metrics, computed in the database."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import ColumnElement, Connection, func, select

from graspd.service.index.database import IndexPart
from graspd.service.index.queries.grasps import GraspFilter, Metric, conditions, estimate_row_count
from graspd.service.index.tables import grasps


@dataclass(frozen=True)
class Distribution:
    """Histogram of one metric over the sampled grasps: equal bins from `low` to `high`, inclusive."""

    count: int
    mean: float
    low: float
    high: float
    counts: list[int]

    @property
    def bins(self) -> list[tuple[float, float, int]]:
        """Low end, high end and count of each bin."""
        ends = np.linspace(self.low, self.high, len(self.counts) + 1).tolist()
        return list(zip(ends, ends[1:], self.counts, strict=False))


@dataclass(frozen=True)
class GraspKinds:
    """Numbers of grasps of each `GraspType` and of each approach cell, without grasps that lack the value."""

    types: dict[int, int]
    cells: dict[int, int]


class Statistics(IndexPart):
    def compare_distributions(
        self, filters: Sequence[GraspFilter], metrics: Sequence[Metric], *, bins: int = 20, at_most: int = 20_000
    ) -> dict[Metric, list[Distribution | None]]:
        """Return one distribution per metric and filter, in common bins; None without grasps.

        It covers a fair sample of about `at_most` grasps per filter: shards whose id, a digest, is below a bound.
        """
        samples = [self._sampled_values(where, metrics, at_most) for where in filters]
        found: dict[Metric, list[Distribution | None]] = {}
        for at, metric in enumerate(metrics):
            columns = [values[:, at] for values in samples]
            known = np.concatenate([column[np.isfinite(column)] for column in columns])
            if known.size:
                ends = (float(known.min()), float(known.max()))
                found[metric] = [_distribution(column, bins, ends) for column in columns]
        return found

    def _sampled_values(self, where: GraspFilter, metrics: Sequence[Metric], at_most: int) -> NDArray[np.float64]:
        rows, _ = self.sample(where, metrics, at_most)
        return np.array([tuple(row) for row in rows], float).reshape(-1, len(metrics))

    def sample(self, where: GraspFilter, columns: Sequence[str], at_most: int) -> tuple[Sequence[Any], float]:
        """Return columns of a fair sample of about `at_most` grasps, and its share of all shards."""
        with self.database.read_transaction() as connection:
            tests, share = _sample_conditions(connection, where, at_most)
            return connection.execute(select(*(grasps.c[name] for name in columns)).where(*tests)).all(), share

    def kinds(self, where: GraspFilter, *, at_most: int = 20_000) -> GraspKinds:
        """Count types and approach cells of about `at_most` grasps, sampled as in `compare_distributions`."""
        columns = grasps.c.grasp_type, grasps.c.approach_cell
        with self.database.read_transaction() as connection:
            tests, _ = _sample_conditions(connection, where, at_most)
            rows = connection.execute(select(*columns, func.count()).where(*tests).group_by(*columns)).all()
        found = GraspKinds({}, {})
        for kind, cell, count in rows:
            for counts, value in ((found.types, kind), (found.cells, cell)):
                if value is not None:
                    counts[int(value)] = counts.get(int(value), 0) + int(count)
        return found


def _sample_conditions(
    connection: Connection, where: GraspFilter, at_most: int
) -> tuple[list[ColumnElement[bool]], float]:
    """Return the conditions of a filter on a share of the shards with `at_most` grasps; the share."""
    groups = [name for name in ("job", "dataset", "tag") if getattr(where, name) is not None] or ["pair"]
    least = min(estimate_row_count(connection, where, group) for group in groups)
    share = min(1.0, at_most / max(1, least))
    tests = [c.sql(["job", "dataset", "tag"]) for c in conditions(where)]
    if share == 1.0:
        return tests, share
    bound = round(share * 16**8)
    return [*tests, grasps.c.shard_id < f"{bound:08x}"], bound / 16**8


def _distribution(values: NDArray[np.float64], bins: int, ends: tuple[float, float]) -> Distribution | None:
    known = values[np.isfinite(values)]
    if not known.size:
        return None
    low, high = ends
    counts, _ = np.histogram(known, bins, (low, high)) if high > low else ([known.size] + [0] * (bins - 1), None)
    return Distribution(known.size, float(known.mean()), low, high, [int(n) for n in counts])
