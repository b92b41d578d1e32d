"""Queries of hands and objects, and of named sets of objects."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

from sqlalchemy import ColumnElement, Connection, and_, case, or_, select, tuple_

from graspd.service.index import project_scope
from graspd.service.index.database import Database, chunks
from graspd.service.index.project_scope import nearest_asset, seen_assets, seen_sets
from graspd.service.index.tables import assets, object_sets
from graspd.service.index.views import AssetView, ObjectSetView, Page
from graspd.service.model.errors import SEARCHED, NotFoundError, known_names
from graspd.service.model.projects import EVERYTHING, ProjectScope
from graspd.service.model.states import AssetKind


@dataclass(frozen=True)
class Assets:
    """Reads of hands and objects."""

    database: Database

    def page(
        self,
        kind: AssetKind,
        *,
        limit: int = 50,
        cursor: str | None = None,
        refused: bool = False,
        scope: ProjectScope = EVERYTHING,
    ) -> Page[AssetView]:
        """Return a page of hands or objects, all versions, newest first; refused ones only on request."""
        size = project_scope.page_size(limit)
        query = select(assets).where(assets.c.kind == kind.value, *seen_assets(scope))
        if not refused:
            query = query.where(_not_refused())
        query = query.order_by(assets.c.created.desc(), assets.c.digest.desc()).limit(size + 1)
        if cursor is not None:
            query = query.where(tuple_(assets.c.created, assets.c.digest) < project_scope.decode(cursor, str, str))
        with self.database.reading() as connection:
            rows = connection.execute(query).mappings().all()
        views = [_asset_view(row) for row in rows[:size]]
        last = views[-1] if len(rows) > size else None
        return Page(items=views, next=last and project_scope.encode(last.created, last.digest))

    def get(self, kind: AssetKind, name_or_digest: str, *, scope: ProjectScope = EVERYTHING) -> AssetView:
        """Return a hand or object by digest, or the newest usable one of a name, the project's own first.

        Raises:
            NotFoundError: it does not exist; the message lists the existing names.
        """
        named = and_(assets.c.kind == kind.value, assets.c.name == name_or_digest)
        by_digest = and_(assets.c.kind == kind.value, assets.c.digest == name_or_digest)
        refused_last = case((assets.c.verdict == "refuse", 1), else_=0)
        query = select(assets).where(named | by_digest, *seen_assets(scope))
        query = query.order_by(
            refused_last, nearest_asset(scope), assets.c.created.desc(), assets.c.digest.desc()
        ).limit(1)
        with self.database.reading() as connection:
            row = connection.execute(query).mappings().first()
            if row is None:
                known = (
                    select(assets.c.name)
                    .where(assets.c.kind == kind.value, _not_refused(), *seen_assets(scope))
                    .distinct()
                    .order_by(assets.c.name)
                )
                names = list(connection.scalars(known.limit(SEARCHED)))
                raise NotFoundError(f"there is no {kind.value} {name_or_digest!r}{known_names(name_or_digest, names)}")
        return _asset_view(row)

    def sizes(self, kind: AssetKind, wanted: Collection[str], *, scope: ProjectScope = EVERYTHING) -> dict[str, int]:
        """Return the sizes [bytes] of the named hands or objects; unknown names are omitted."""
        names = set(wanted)
        query = select(assets.c.name, assets.c.size_bytes).where(assets.c.kind == kind.value, *seen_assets(scope))
        query = query.order_by(assets.c.created)
        with self.database.reading() as connection:
            return {name: size for name, size in connection.execute(query) if name in names}

    def missing(self, wanted: Collection[tuple[AssetKind, str]], *, within: Connection) -> list[str]:
        """Return those of the kinds and digests that the index lacks."""
        digests = sorted({digest for _, digest in wanted})
        known = set()
        for some in chunks(digests):
            query = select(assets.c.kind, assets.c.digest).where(assets.c.digest.in_(some))
            known |= {(AssetKind(kind), digest) for kind, digest in within.execute(query)}
        return [f"{kind.value} {digest}" for kind, digest in wanted if (kind, digest) not in known]


def _not_refused() -> ColumnElement[bool]:
    """Return the condition of a usable asset, or one in its check."""
    return or_(assets.c.verdict.is_(None), assets.c.verdict != "refuse")


def _asset_view(row: Any) -> AssetView:
    return AssetView(**{name: row[name] for name in AssetView.model_fields})


@dataclass(frozen=True)
class ObjectSets:
    """Reads of named sets of objects."""

    database: Database

    def newest(self, *, scope: ProjectScope = EVERYTHING) -> list[ObjectSetView]:
        """Return the newest version of each set of objects, by name."""
        query = select(object_sets).where(*seen_sets(scope))
        query = query.order_by(object_sets.c.name, object_sets.c.created, object_sets.c.digest)
        with self.database.reading() as connection:
            newest = {row["name"]: ObjectSetView(**row) for row in connection.execute(query).mappings()}
        return list(newest.values())

    def named(self, name: str) -> ObjectSetView | None:
        """Return the newest version of a set of any project; None if there is none."""
        query = select(object_sets).where(object_sets.c.name == name)
        query = query.order_by(object_sets.c.created.desc(), object_sets.c.digest.desc()).limit(1)
        with self.database.reading() as connection:
            row = connection.execute(query).mappings().first()
        return None if row is None else ObjectSetView(**row)

    def get(self, name: str, *, scope: ProjectScope = EVERYTHING) -> ObjectSetView:
        """Return the newest version of a set of objects; NotFoundError if there is none."""
        found = {view.name: view for view in self.newest(scope=scope)}
        if name not in found:
            raise NotFoundError(f"there is no set of objects {name!r}{known_names(name, list(found)[:SEARCHED])}")
        return found[name]
