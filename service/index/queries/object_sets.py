"""Queries on named sets of objects."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import select

from service.index.database import Database
from service.index.dataset_tables import object_sets
from service.index.dataset_views import ObjectSetView
from service.index.reach import seen_sets
from service.model.errors import NotFoundError
from service.model.projects import EVERYTHING, Reach
from service.model.suggestions import SEARCHED, known_names


@dataclass(frozen=True)
class ObjectSets:
    """Reads on named sets of objects."""

    database: Database

    def newest(self, *, reach: Reach = EVERYTHING) -> list[ObjectSetView]:
        """The newest version of each set of objects, by name."""
        query = select(object_sets).where(*seen_sets(reach))
        query = query.order_by(object_sets.c.name, object_sets.c.created, object_sets.c.digest)
        with self.database.reading() as connection:
            newest = {row["name"]: ObjectSetView(**row) for row in connection.execute(query).mappings()}
        return list(newest.values())

    def named(self, name: str) -> ObjectSetView | None:
        """The newest version of a set, of whatever project; None if there is none of that name."""
        query = select(object_sets).where(object_sets.c.name == name)
        query = query.order_by(object_sets.c.created.desc(), object_sets.c.digest.desc()).limit(1)
        with self.database.reading() as connection:
            row = connection.execute(query).mappings().first()
        return None if row is None else ObjectSetView(**row)

    def get(self, name: str, *, reach: Reach = EVERYTHING) -> ObjectSetView:
        """The newest version of a set of objects; NotFoundError if there is none of that name."""
        found = {view.name: view for view in self.newest(reach=reach)}
        if name not in found:
            raise NotFoundError(f"there is no set of objects {name!r}{known_names(name, list(found)[:SEARCHED])}")
        return found[name]
