"""Queries on shards."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any, Literal

from sqlalchemy import select, tuple_

from service.index.database import Database
from service.index.project_scope import seen_shards, seen_tasks
from service.index.queries import cursors
from service.index.tables import shards, tasks
from service.index.views import Page, ShardView
from service.model.errors import NotFoundError
from service.model.projects import EVERYTHING, ProjectScope


@dataclass(frozen=True)
class Shards:
    """Reads on shards."""

    database: Database

    def page(
        self,
        *,
        job: str | None = None,
        kind: Literal["base", "scene", "views"] | None = None,
        hand: str | None = None,
        object: str | None = None,
        limit: int = 50,
        cursor: str | None = None,
        scope: ProjectScope = EVERYTHING,
    ) -> Page[ShardView]:
        """Shards, newest first, without their manifests."""
        size = cursors.page_size(limit)
        query = (
            select(shards)
            .where(*seen_shards(scope, shards.c.id))
            .order_by(shards.c.created.desc(), shards.c.id.desc())
            .limit(size + 1)
        )
        for column, wanted in ((shards.c.kind, kind), (shards.c.hand, hand), (shards.c.object, object)):
            if wanted is not None:
                query = query.where(column == wanted)
        if job is not None:
            query = query.where(shards.c.id.in_(select(tasks.c.shard_id).where(tasks.c.job_id == job)))
        if cursor is not None:
            query = query.where(tuple_(shards.c.created, shards.c.id) < cursors.decode(cursor, str, str))
        with self.database.reading() as connection:
            rows = connection.execute(query).mappings().all()
        views = [_shard_view(row, whole=False) for row in rows[:size]]
        last = views[-1] if len(rows) > size else None
        return Page(items=views, next=last and cursors.encode(last.created, last.id))

    def assets_of(self, ids: Collection[str]) -> dict[str, tuple[str, str]]:
        """Digests of hand and object of each of these shards."""
        query = select(shards.c.id, shards.c.hand_digest, shards.c.object_digest).where(shards.c.id.in_(ids))
        with self.database.reading() as connection:
            return {shard: (hand, obj) for shard, hand, obj in connection.execute(query)}

    def job_of(self, shard_id: str, *, scope: ProjectScope = EVERYTHING) -> str | None:
        """A job in scope that wanted this shard; several may, and a pruned index may know none."""
        with self.database.reading() as connection:
            query = select(tasks.c.job_id).where(tasks.c.shard_id == shard_id, *seen_tasks(scope)).limit(1)
            found: str | None = connection.scalar(query)
        return found

    def get(self, shard_id: str, *, scope: ProjectScope = EVERYTHING) -> ShardView:
        """A shard with its manifest; NotFoundError if there is none."""
        with self.database.reading() as connection:
            seen = seen_shards(scope, shards.c.id)
            row = connection.execute(select(shards).where(shards.c.id == shard_id, *seen)).mappings().first()
        if row is None:
            raise NotFoundError(f"there is no shard {shard_id!r}")
        return _shard_view(row, whole=True)


def _shard_view(row: Any, *, whole: bool) -> ShardView:
    values = {name: row[name] for name in ShardView.model_fields if name != "manifest"}
    return ShardView(**values, manifest=row["manifest"] if whole else {})
