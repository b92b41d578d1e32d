"""Queries of hands and objects, and of named sets of objects."""

from collections.abc import Collection
from typing import Unpack

from sqlalchemy import ColumnElement, Connection, and_, case, or_, select

from graspd.service.index import database
from graspd.service.index.tables import assets, object_sets
from graspd.service.index.views import AssetView, ObjectSetView, Page
from graspd.service.model.errors import SEARCHED, NotFoundError, available_names
from graspd.service.model.projects import EVERYTHING, ProjectScope
from graspd.service.model.states import AssetKind


class Assets(database.IndexPart):
    def page(
        self,
        kind: AssetKind,
        *,
        refused: bool = False,
        scope: ProjectScope = EVERYTHING,
        **part: Unpack[database.Paging],
    ) -> Page[AssetView]:
        """Return a page of hands or objects in all versions, newest first; `refused` includes refused ones."""
        query = select(assets).where(assets.c.kind == kind.value, *database.asset_scope_conditions(scope))
        if not refused:
            query = query.where(_not_refused())
        with self.database.read_transaction() as connection:
            key = assets.c.created, assets.c.digest
            rows, following = database.page_rows(connection, query, *key, **part)
        return Page(items=[AssetView(**row) for row in rows], next=following)

    def get(self, kind: AssetKind, name_or_digest: str, *, scope: ProjectScope = EVERYTHING) -> AssetView:
        """Return an asset by digest or name, if possible not refused, own, newest; NotFoundError if none."""
        named = and_(assets.c.kind == kind.value, assets.c.name == name_or_digest)
        by_digest = and_(assets.c.kind == kind.value, assets.c.digest == name_or_digest)
        refused_last = case((assets.c.verdict == "refuse", 1), else_=0)
        query = select(assets).where(named | by_digest, *database.asset_scope_conditions(scope))
        order = (refused_last, database.asset_scope_order(scope), assets.c.created.desc(), assets.c.digest.desc())
        if found := self.database.rows(query.order_by(*order).limit(1)):
            return AssetView(**found[0])
        known = select(assets.c.name).where(
            assets.c.kind == kind.value, _not_refused(), *database.asset_scope_conditions(scope)
        )
        names = self.database.column(known.distinct().order_by(assets.c.name).limit(SEARCHED))
        raise NotFoundError(f"there is no {kind.value} {name_or_digest!r}{available_names(name_or_digest, names)}")

    def refused(self, *, before: str, limit: int = 200) -> list[AssetView]:
        """Return refused assets that were uploaded before a time, oldest first."""
        query = select(assets).where(assets.c.verdict == "refuse", assets.c.created < before)
        return [AssetView(**row) for row in self.database.rows(query.order_by(assets.c.created).limit(limit))]

    def sizes(self, kind: AssetKind, wanted: Collection[str], *, scope: ProjectScope = EVERYTHING) -> dict[str, int]:
        """Return the sizes [bytes] of the named hands or objects; unknown names are omitted."""
        query = select(assets.c.name, assets.c.size_bytes).order_by(assets.c.created)
        query = query.where(assets.c.kind == kind.value, *database.asset_scope_conditions(scope))
        sizes = {row["name"]: row["size_bytes"] for row in self.database.rows(query)}
        return {name: sizes[name] for name in wanted if name in sizes}

    def missing(self, wanted: Collection[tuple[AssetKind, str]], *, within: Connection) -> list[str]:
        query = select(assets.c.kind, assets.c.digest)
        rows = database.rows_in(within, query, assets.c.digest, {digest for _, digest in wanted})
        known = {(AssetKind(kind), digest) for kind, digest in rows}
        return [f"{kind.value} {digest}" for kind, digest in wanted if (kind, digest) not in known]


def _not_refused() -> ColumnElement[bool]:
    """Return the condition that an asset is usable or still being checked."""
    return or_(assets.c.verdict.is_(None), assets.c.verdict != "refuse")


class ObjectSets(database.IndexPart):
    def newest_versions(self, *, scope: ProjectScope = EVERYTHING) -> list[ObjectSetView]:
        query = select(object_sets).where(*database.scope_conditions(scope, object_sets))
        query = query.order_by(object_sets.c.name, object_sets.c.created, object_sets.c.digest)
        return list({row["name"]: ObjectSetView(**row) for row in self.database.rows(query)}.values())

    def newest_version(self, name: str) -> ObjectSetView | None:
        """Return the newest set of this name in any project; None if there is none."""
        query = select(object_sets).where(object_sets.c.name == name)
        rows = self.database.rows(query.order_by(object_sets.c.created.desc(), object_sets.c.digest.desc()).limit(1))
        return ObjectSetView(**rows[0]) if rows else None

    def get(self, name: str, *, scope: ProjectScope = EVERYTHING) -> ObjectSetView:
        found = {view.name: view for view in self.newest_versions(scope=scope)}
        if name not in found:
            raise NotFoundError(f"there is no set of objects {name!r}{available_names(name, list(found)[:SEARCHED])}")
        return found[name]
