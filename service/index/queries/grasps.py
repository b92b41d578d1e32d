"""Queries on grasps."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

from sqlalchemy import select, tuple_

from service.index.database import Database, chunks
from service.index.filters import GraspFilter, GraspSort
from service.index.project_scope import seen_shards
from service.index.queries import cursors
from service.index.queries.grasp_search import search, sql_conditions
from service.index.tables import grasps
from service.index.views import GraspView, Page
from service.model.errors import NotFoundError
from service.model.projects import EVERYTHING, ProjectScope
from service.model.tags import Grasp

_BEST_FIRST = GraspSort()
#: Grasps that one statement names: two parameters each.
_AT_ONCE: Final = 400


@dataclass(frozen=True)
class Grasps:
    """Reads on grasps."""

    database: Database

    def page(
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
        with self.database.reading() as connection:
            rows = search(connection, where, sort, size + 1, start)
        views = [_view(row) for row in rows[:size]]
        last = rows[size - 1] if len(rows) > size else None
        return Page(items=views, next=last and cursors.encode(last[sort.by], last["shard_id"], last["row"]))

    def get(self, shard_id: str, row: int, *, scope: ProjectScope = EVERYTHING) -> GraspView:
        """One grasp by its shard and row; NotFoundError if there is none."""
        query = select(grasps).where(grasps.c.shard_id == shard_id, grasps.c.row == row)
        query = query.where(*seen_shards(scope, grasps.c.shard_id))
        with self.database.reading() as connection:
            found = connection.execute(query).mappings().first()
        if found is None:
            raise NotFoundError(f"there is no grasp {row} in shard {shard_id!r}")
        return _view(found)

    def members(self, where: GraspFilter, *, limit: int) -> list[Grasp]:
        """Shard and row of the grasps that pass, in this order; of more than `limit` only so many."""
        query = select(grasps.c.shard_id, grasps.c.row).order_by(grasps.c.shard_id, grasps.c.row).limit(limit)
        with self.database.reading() as connection:
            return [(shard, row) for shard, row in connection.execute(query.where(*sql_conditions(where)))]

    def listed(self, wanted: Sequence[Grasp]) -> Iterator[GraspView]:
        """Grasps by shard and row, in that order; those that are not there are left out."""
        for some in chunks(sorted(wanted), _AT_ONCE):
            query = select(grasps).where(tuple_(grasps.c.shard_id, grasps.c.row).in_(some))
            with self.database.reading() as connection:
                rows = connection.execute(query.order_by(grasps.c.shard_id, grasps.c.row)).mappings().all()
            yield from map(_view, rows)


def _view(row: Any) -> GraspView:
    return GraspView(**{name: row[name] for name in GraspView.model_fields})
