"""Records of tags in the store: each change is a record of its own, and the last one counts."""

from __future__ import annotations

from service.model import names
from service.model.errors import ConflictError
from service.model.tags import Tag
from service.store.records import Put, read_record
from service.store.store import Store


def newest_version(store: Store, tag: str) -> Tag | None:
    """A tag as it is; None: there is none.

    Raises:
        DamagedError: its record is not what its name says.
    """
    keys = sorted(entry.key for entry in store.list(names.tag_versions(tag)))
    return read_record(Tag, store, keys[-1]) if keys else None


def put_version(put: Put, tag: Tag) -> None:
    """Write a tag after a change.

    Raises:
        ConflictError: another change came first.
    """
    if not put(names.tag_version(tag.id, tag.number), tag):
        raise ConflictError(f"the tag {tag.name!r} was changed a moment ago; try again")


def drop_older(store: Store, tag: Tag) -> None:
    """Remove the versions that no longer count; of a tag that is gone the last one too, which goes last."""
    last = names.tag_version(tag.id, tag.number)
    for key in sorted(entry.key for entry in store.list(names.tag_versions(tag.id))):
        if key < last or (key == last and tag.gone):
            store.delete(key)
