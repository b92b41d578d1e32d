"""Records of what users deleted: a record is the fact, the rest follows."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterable
from typing import Final, Literal

from pydantic import Field

from service.model import names
from service.model.errors import ConflictError, DamagedError, NotFoundError
from service.model.records import JobRecord, Record
from service.store.records import read_record
from service.store.store import Store

_DIGITS: Final = re.compile(r"\D")
What = Literal["hand", "object", "network", "job", "dataset", "tag"]


class Deletion(Record):
    """One thing that is gone, and what its removal needs to know once its own record is gone too."""

    version: Literal[1] = 1
    what: What
    id: str
    at: str
    owner: str = Field("", description="id of the API key that deleted it")
    name: str = Field("", description="what its users call it, where that is not its id")
    submitter: str = Field("", description="id of the API key that it was submitted with")
    project: str = ""
    job: JobRecord | None = None
    attempts: tuple[tuple[str, int], ...] = ()


class Released(Record):
    """A job that was deleted: its shards go when nobody has needed them for the grace time."""

    version: Literal[1] = 1
    at: str
    job: JobRecord


def pending(store: Store) -> set[tuple[str, str]]:
    """Kind and id of all that is gone but still has objects in the store."""
    keys = [entry.key.split("/") for entry in store.list(names.DELETIONS)]
    return {(key[1], key[2].removesuffix(".json")) for key in keys if len(key) == 3}


def refuse_pending(store: Store, what: str, name: str) -> None:
    """ConflictError while a thing of this id is being removed: what is new would be removed with it."""
    if store.exists(names.deletion(what, name)):
        raise ConflictError(f"the {what} {name} of before is still being removed; try again in a moment")


def removed_folder(deletion: Deletion) -> str:
    """Where the objects of a deleted thing lie until the grace time ends; the same deletion has the same."""
    return f"{names.REMOVED}/{_DIGITS.sub('', deletion.at)}-{deletion.what}-{deletion.id}"


def removed_before(key: str, at: str) -> bool:
    """Whether an object below `removed/` belongs to a deletion from before a time."""
    return key.split("/")[1].partition("-")[0] < _DIGITS.sub("", at)


def deletions(store: Store, what: str = "") -> list[Deletion]:
    """Deletions that can be taken back, the newest first; of one kind of thing or of all."""
    found: dict[str, Deletion] = {}

    def read(keys: Iterable[str]) -> None:
        for key in keys:
            with contextlib.suppress(NotFoundError, DamagedError):
                deletion = read_record(Deletion, store, key)
                found[removed_folder(deletion)] = deletion

    # What the controller moves meanwhile is in the second folder before it leaves the first.
    waiting = [entry.key for entry in store.list(names.DELETIONS) if entry.key.count("/") == 2]
    read(key for key in waiting if not what or key.split("/")[1] == what)
    removed = [entry.key for entry in store.list(names.REMOVED) if entry.key.count("/") == 2]
    read(key for key in removed if not what or key.split("-")[1] == what)
    return sorted(found.values(), key=lambda one: one.at, reverse=True)


def released_key(deletion: Deletion) -> str:
    """Where a deleted job's shards are remembered; the same deletion, carried out again, has the same."""
    return f"{names.RELEASED}/{_DIGITS.sub('', deletion.at)}-{deletion.id}.json"
