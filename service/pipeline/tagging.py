"""Changes of tags: each writes the record, then the rows, within one write transaction of the index."""

from collections.abc import Callable, Collection

from graspd.service.model import names
from graspd.service.model.clock import timestamp
from graspd.service.model.errors import ConflictError, LimitError, NotFoundError
from graspd.service.model.records import MOST_TAGGED, Grasp, Tag, rows_by_shard, tag_id
from graspd.service.pipeline.backends import Services, record_transaction
from graspd.service.store import records

#: Called with the tag to change, None for a new one; raises if the change is not allowed.
Permit = Callable[[Tag | None], None]


def tag_grasps(
    services: Services, name: str, grasps: Collection[Grasp], *, project: str, owner: str, permit: Permit
) -> int:
    """Add a tag to grasps; return how many did not have it. LimitError: more than `MOST_TAGGED` in all."""

    def add_grasps(tag: Tag) -> Tag:
        members = tag.members | set(grasps)
        if len(members) > MOST_TAGGED:
            raise LimitError(f"the tag {name!r} would name {len(members)} grasps; a tag names at most {MOST_TAGGED}")
        return tag.model_copy(update={"grasps": rows_by_shard(members)})

    now = timestamp()
    fresh = Tag(id=tag_id(name, project), name=name, number=1, created=now, changed=now, owner=owner, project=project)
    before, after = _change_tag(services, fresh.id, add_grasps, permit, fresh=fresh)
    return len(after.members) - len(before.members)


def untag_grasps(services: Services, tag: str, grasps: Collection[Grasp], *, permit: Permit) -> int:
    """Remove a tag, by its id, from grasps; return how many had it."""

    def remove_grasps(one: Tag) -> Tag:
        return one.model_copy(update={"grasps": rows_by_shard(one.members - set(grasps))})

    before, after = _change_tag(services, tag, remove_grasps, permit)
    return len(before.members) - len(after.members)


def delete_tag(services: Services, tag: str, *, permit: Permit, owner: str = "") -> None:
    """Delete a tag by its id; its list of grasps is stored for the grace time."""

    def mark_deleted(one: Tag) -> Tag:
        said = {"name": one.name, "submitter": one.owner, "project": one.project}
        deletion = records.Deletion(what="tag", id=one.id, at=timestamp(), owner=owner, **said)
        folder = records.removed_folder(deletion)
        records.put_record(services.store, f"{folder}/{names.tag_version_key(one.id, one.number)}", one)
        records.put_record(services.store, f"{folder}/deletion.json", deletion)
        return one.model_copy(update={"grasps": {}, "gone": True})

    _change_tag(services, tag, mark_deleted, permit)


def restore_tag(services: Services, tag: Tag) -> None:
    """Restore a deleted tag with its grasps; ConflictError if the name is in use again."""

    def permit(known: Tag | None) -> None:
        if known is not None:
            raise ConflictError(f"there is a tag {tag.name!r} again; delete that first")

    _change_tag(services, tag.id, lambda one: one, permit, fresh=tag)


def _change_tag(
    services: Services, tag: str, change: Callable[[Tag], Tag], permit: Permit, *, fresh: Tag | None = None
) -> tuple[Tag, Tag]:
    """Change a tag, or the new tag `fresh`; return it before and after; NotFoundError without either."""
    with record_transaction(services) as (connection, put):
        found = records.newest_tag_version(services.store, tag)
        known = None if found is None or found.gone else found
        if known is None and fresh is None:
            raise NotFoundError(f"there is no tag {tag!r}")
        permit(known)
        before = known or fresh
        assert before is not None
        after = change(before).model_copy(update={"number": found.number + 1 if found else 1, "changed": timestamp()})
        is_changed = known is None or after.members != before.members or after.gone
        if is_changed:
            records.put_tag_version(put, after)
            services.index.tags.put(after, within=connection)
    if is_changed:
        # Older versions are deleted after the commit, while no other process can read the last version.
        with services.index.database.write_transaction():
            records.delete_older_tag_versions(services.store, after)
    return before, after
