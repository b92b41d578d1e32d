"""Tags: users' names for grasps, from records of the store."""

from collections.abc import Collection, Sequence

from sqlalchemy import Connection, case, delete, func, select, tuple_

from graspd.service.index.database import IndexPart, scope_conditions, shard_scope_conditions, upsert
from graspd.service.index.tables import grasps, tagged, tags
from graspd.service.index.views import TagView
from graspd.service.model.errors import NotFoundError
from graspd.service.model.projects import EVERYTHING, ProjectScope
from graspd.service.model.records import Grasp, Tag


class Tags(IndexPart):
    def all(self, *, scope: ProjectScope = EVERYTHING) -> list[TagView]:
        existing = (grasps.c.shard_id == tagged.c.shard_id) & (grasps.c.row == tagged.c.row)
        number = select(func.count()).select_from(tagged.join(grasps, existing)).where(tagged.c.tag == tags.c.id)
        query = select(tags, number.scalar_subquery().label("grasps")).where(*scope_conditions(scope, tags))
        return [TagView(**row) for row in self.database.rows(query.order_by(tags.c.name, tags.c.project))]

    def id_of(self, name: str, *, scope: ProjectScope = EVERYTHING) -> str:
        """Return the id of a tag by id or name, own tags first; NotFoundError if no such tag is in scope."""
        own_first = case((tags.c.id == name, 0), (tags.c.project == scope.project, 1), else_=2)
        query = select(tags.c.id).where((tags.c.name == name) | (tags.c.id == name), *scope_conditions(scope, tags))
        found = self.database.value(query.order_by(own_first, tags.c.project).limit(1))
        if found is None:
            raise NotFoundError(f"there is no tag {name!r}")
        return str(found)

    def names_by_grasp(self, wanted: Collection[Grasp], *, scope: ProjectScope = EVERYTHING) -> dict[Grasp, list[str]]:
        """Return the tag names of each given grasp that has any."""
        found: dict[Grasp, list[str]] = {}
        query = select(tagged.c.shard_id, tagged.c.row, tags.c.name).order_by(tags.c.name)
        query = query.where(tags.c.id == tagged.c.tag, *scope_conditions(scope, tags))
        key = tuple_(tagged.c.shard_id, tagged.c.row)
        for shard, row, name in self.database.matching_rows(query, key, sorted(wanted)):
            found.setdefault((shard, row), []).append(name)
        return found

    def existing_grasps(self, wanted: Sequence[Grasp], *, scope: ProjectScope = EVERYTHING) -> set[Grasp]:
        query = select(grasps.c.shard_id, grasps.c.row).where(*shard_scope_conditions(scope, grasps.c.shard_id))
        key = tuple_(grasps.c.shard_id, grasps.c.row)
        return {(shard, row) for shard, row in self.database.matching_rows(query, key, wanted)}

    def put(self, tag: Tag, *, within: Connection | None = None) -> None:
        row = {name: getattr(tag, name) for name in ("id", "name", "created", "changed", "owner", "project")}
        members = [{"tag": tag.id, "shard_id": shard, "row": number} for shard, number in sorted(tag.members)]
        with self.database.write_transaction(within) as connection:
            connection.execute(delete(tagged).where(tagged.c.tag == tag.id))
            connection.execute(delete(tags).where(tags.c.id == tag.id))
            if not tag.gone:
                upsert(connection, tags, [row])
                upsert(connection, tagged, members)
