"""Queries on grasps."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import select

from service.index.database import Database
from service.index.filters import GraspFilter, GraspSort
from service.index.queries import cursors
from service.index.queries.grasp_search import search
from service.index.reach import seen_shards
from service.index.tables import grasps
from service.index.views import GraspView, Page
from service.model.errors import NotFoundError
from service.model.projects import EVERYTHING, Reach

_BEST_FIRST = GraspSort()


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
        views = [GraspView(**{name: row[name] for name in GraspView.model_fields}) for row in rows[:size]]
        last = rows[size - 1] if len(rows) > size else None
        return Page(items=views, next=last and cursors.encode(last[sort.by], last["shard_id"], last["row"]))

    def get(self, shard_id: str, row: int, *, reach: Reach = EVERYTHING) -> GraspView:
        """One grasp by its shard and row; NotFoundError if there is none."""
        query = select(grasps).where(grasps.c.shard_id == shard_id, grasps.c.row == row)
        query = query.where(*seen_shards(reach, grasps.c.shard_id))
        with self.database.reading() as connection:
            found = connection.execute(query).mappings().first()
        if found is None:
            raise NotFoundError(f"there is no grasp {row} in shard {shard_id!r}")
        return GraspView(**{name: found[name] for name in GraspView.model_fields})
