"""Queries on grasps and shards."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

from sqlalchemy import ColumnElement, Connection, Select, func, select, tuple_

from service.domain import Stage
from service.errors import NotFoundError
from service.index import cursors
from service.index.database import Database
from service.index.filters import GraspFilter, GraspSort
from service.index.tables import grasps, shards, tasks
from service.index.views import GraspView, Page, ShardView

_BEST_FIRST = GraspSort()
_SORTED_AT_ONCE = 20_000


class GraspQueries(Database):
    """Reads on grasps and shards."""

    def grasps(
        self,
        where: GraspFilter | None = None,
        *,
        sort: GraspSort = _BEST_FIRST,
        limit: int = 50,
        cursor: str | None = None,
    ) -> Page[GraspView]:
        """Grasps in the order of a metric; those without it come last."""
        size = cursors.page_size(limit)
        start = None if cursor is None else cursors.decode(cursor, (float, int, str, type(None)), str, int)
        with self.reading() as connection:
            by_pair = sort.by == "epsilon" or _are_few(connection, where)
            rows = _grasp_rows(connection, _conditions(where, by_pair=by_pair), sort, size + 1, start)
        views = [GraspView(**{name: row[name] for name in GraspView.model_fields}) for row in rows[:size]]
        last = rows[size - 1] if len(rows) > size else None
        return Page(items=views, next=last and cursors.encode(last[sort.by], last["shard_id"], last["row"]))

    def grasp(self, shard_id: str, row: int) -> GraspView:
        """One grasp by its shard and row; NotFoundError if there is none."""
        query = select(grasps).where(grasps.c.shard_id == shard_id, grasps.c.row == row)
        with self.reading() as connection:
            found = connection.execute(query).mappings().first()
        if found is None:
            raise NotFoundError(f"there is no grasp {row} in shard {shard_id!r}")
        return GraspView(**{name: found[name] for name in GraspView.model_fields})

    def grasp_count(self, where: GraspFilter | None = None) -> int:
        """Number of grasps that match."""
        with self.reading() as connection:
            return int(connection.scalar(select(func.count()).select_from(grasps).where(*_conditions(where))) or 0)

    def shards(
        self,
        *,
        job: str | None = None,
        kind: Literal["base", "scene", "views"] | None = None,
        hand: str | None = None,
        object: str | None = None,
        limit: int = 50,
        cursor: str | None = None,
    ) -> Page[ShardView]:
        """Shards, newest first, without their manifests."""
        size = cursors.page_size(limit)
        query = select(shards).order_by(shards.c.created.desc(), shards.c.id.desc()).limit(size + 1)
        for column, wanted in ((shards.c.kind, kind), (shards.c.hand, hand), (shards.c.object, object)):
            if wanted is not None:
                query = query.where(column == wanted)
        if job is not None:
            query = query.where(shards.c.id.in_(select(tasks.c.shard_id).where(tasks.c.job_id == job)))
        if cursor is not None:
            query = query.where(tuple_(shards.c.created, shards.c.id) < cursors.decode(cursor, str, str))
        with self.reading() as connection:
            rows = connection.execute(query).mappings().all()
        views = [_shard_view(row, whole=False) for row in rows[:size]]
        last = views[-1] if len(rows) > size else None
        return Page(items=views, next=last and cursors.encode(last.created, last.id))

    def shard(self, shard_id: str) -> ShardView:
        """A shard with its manifest; NotFoundError if there is none."""
        with self.reading() as connection:
            row = connection.execute(select(shards).where(shards.c.id == shard_id)).mappings().first()
        if row is None:
            raise NotFoundError(f"there is no shard {shard_id!r}")
        return _shard_view(row, whole=True)


def _grasp_rows(
    connection: Connection,
    conditions: Sequence[ColumnElement[bool]],
    sort: GraspSort,
    size: int,
    start: tuple[Any, ...] | None,
) -> list[Any]:
    """Databases differ on where NULL sorts, so rows with the metric and rows without are two queries."""
    by = grasps.c[sort.by]
    rows: list[Any] = []
    if start is None or start[0] is not None:
        query = select(grasps).where(by.is_not(None), *conditions)
        rows += connection.execute(_slice(query, (by, grasps.c.shard_id, grasps.c.row), sort, size, start)).mappings()
    if len(rows) < size:
        query = select(grasps).where(by.is_(None), *conditions)
        after = start[1:] if start is not None and start[0] is None else None
        key = (grasps.c.shard_id, grasps.c.row)
        rows += connection.execute(_slice(query, key, sort, size - len(rows), after)).mappings()
    return rows


def _slice(
    query: Select[Any], key: tuple[ColumnElement[Any], ...], sort: GraspSort, size: int, start: tuple[Any, ...] | None
) -> Select[Any]:
    if start is not None:
        position = tuple_(*key)
        query = query.where(position < start if sort.descending else position > start)
    return query.order_by(*(part.desc() if sort.descending else part for part in key)).limit(size)


def _are_few(connection: Connection, where: GraspFilter | None) -> bool:
    """Whether the grasps of the filter's hand and object are so few that sorting all of them is the quickest way."""
    if where is None or (where.hand is None and where.object is None):
        return False
    pair = [shards.c[name] == v for name, v in {"hand": where.hand, "object": where.object}.items() if v is not None]
    count = connection.scalar(select(func.sum(shards.c.count)).where(shards.c.kind == "base", *pair))
    return int(count or 0) <= _SORTED_AT_ONCE


def _conditions(where: GraspFilter | None, *, by_pair: bool = True) -> list[ColumnElement[bool]]:
    """The filter in SQL; without `by_pair` the database cannot use its indexes of hand and object.

    SQLite would take such an index for any sort, and then sort a million rows to show fifty.
    """
    if where is None:
        return []
    pair: list[tuple[ColumnElement[str], str | None]] = [(grasps.c.hand, where.hand), (grasps.c.object, where.object)]
    conditions: list[ColumnElement[bool]] = [
        (column if by_pair else func.coalesce(column, "")) == value for column, value in pair if value is not None
    ]
    if where.shard is not None:
        conditions.append(grasps.c.shard_id == where.shard)
    flags = {"valid": where.valid, "success": where.success}
    conditions += [grasps.c[name].is_(v) for name, v in flags.items() if v is not None]
    conditions += [grasps.c[name] >= bound for name, bound in where.at_least.items()]
    conditions += [grasps.c[name] <= bound for name, bound in where.at_most.items()]
    if where.job is not None:
        made = (tasks.c.job_id == where.job, tasks.c.stage == Stage.SYNTHESIZE.value)
        conditions.append(grasps.c.shard_id.in_(select(tasks.c.shard_id).where(*made)))
    return conditions


def _shard_view(row: Any, *, whole: bool) -> ShardView:
    values = {name: row[name] for name in ShardView.model_fields if name != "manifest"}
    return ShardView(**values, manifest=row["manifest"] if whole else {})
