"""What a user takes away: hands, objects, jobs, datasets. A record of the deletion is the fact; the rest follows.

`deletions/{what}/{id}.json` is written while nobody else writes the index, in the same step as the rows go. From then
on the thing is gone: a rebuild leaves it out, and nothing of that id is taken in. The keeper (`service.sweeper`)
removes the objects behind it, then the record itself; killed at any moment, it begins again.
"""

from __future__ import annotations

import re
from typing import Final, Literal

from pydantic import Field

from service import names
from service.clock import timestamp
from service.domain import AssetKind
from service.errors import ConflictError, DamagedError, NotFoundError
from service.parts import Parts
from service.records import JobRecord, Record, put_record, read_record
from service.store import Store

What = Literal["hand", "object", "job", "dataset"]
_DIGITS: Final = re.compile(r"\D")


class Deletion(Record):
    """One thing that is gone, and what its removal needs to know once its own record is gone too."""

    version: Literal[1] = 1
    what: What
    id: str
    at: str
    owner: str = Field("", description="id of the API key that deleted it")
    job: JobRecord | None = None
    attempts: tuple[tuple[str, int], ...] = ()


class Released(Record):
    """A job that was deleted: its shards go when nobody has needed them for the grace time."""

    version: Literal[1] = 1
    at: str
    job: JobRecord


def delete_asset(parts: Parts, kind: AssetKind, name: str, *, owner: str = "") -> None:
    """Take a hand or object away.

    Raises:
        NotFoundError: there is none of that name or digest.
        ConflictError: it comes with graspd, or a job, a dataset or a set of objects needs it.
    """
    asset = parts.index.asset(kind, name)
    if asset.builtin:
        raise ConflictError(f"the {kind.value} {asset.name!r} comes with graspd and cannot be deleted")
    with parts.index.writing() as connection:
        if user := parts.index.user_of_asset(kind, asset.name, asset.digest, within=connection):
            raise ConflictError(f"the {kind.value} {asset.name!r} is needed by {user}; delete that first")
        _record(parts.store, Deletion(what=kind.value, id=asset.digest, at=timestamp(), owner=owner))
        parts.index.remove_asset(kind, asset.digest, within=connection)


def delete_job(parts: Parts, job_id: str, *, owner: str = "") -> None:
    """Take a job away; its shards, where no other job needs them, follow after a grace time.

    Raises:
        NotFoundError: there is no such job.
        ConflictError: it has not ended, or a dataset holds it.
    """
    parts.index.job(job_id)
    try:
        record = read_record(JobRecord, parts.store, names.job_record(job_id))
    except (NotFoundError, DamagedError):
        record = None  # then its shards cannot be told, and stay
    with parts.index.writing() as connection:
        if user := parts.index.user_of_job(job_id, within=connection):
            raise ConflictError(f"job {job_id} {user}")
        attempts = parts.index.attempts_of(job_id, within=connection)
        deletion = Deletion(what="job", id=job_id, at=timestamp(), owner=owner, job=record, attempts=attempts)
        _record(parts.store, deletion)
        parts.index.remove_job(job_id, within=connection)


def delete_dataset(parts: Parts, name: str, *, owner: str = "") -> None:
    """Take a dataset away with its snapshots; those of its jobs follow that were planned for it alone.

    Raises:
        NotFoundError: there is no such dataset.
        ConflictError: it has not ended.
    """
    dataset = parts.index.dataset(name)
    if not dataset.state.is_final:
        raise ConflictError(f"dataset {name!r} is {dataset.state}; cancel it first: graspd datasets cancel {name}")
    with parts.index.writing() as connection:
        _record(parts.store, Deletion(what="dataset", id=name, at=timestamp(), owner=owner))
        parts.index.remove_dataset(name, within=connection)


def pending(store: Store) -> set[tuple[str, str]]:
    """Kind and id of all that is gone but still has objects in the store."""
    keys = [entry.key.split("/") for entry in store.list(names.DELETIONS)]
    return {(key[1], key[2].removesuffix(".json")) for key in keys if len(key) == 3}


def refuse_pending(store: Store, what: str, name: str) -> None:
    """ConflictError while a thing of this id is being removed: what is new would be removed with it."""
    if store.exists(names.deletion(what, name)):
        raise ConflictError(f"the {what} {name} of before is still being removed; try again in a moment")


def released_key(deletion: Deletion) -> str:
    """Where a deleted job's shards are remembered; the same deletion, carried out again, has the same."""
    return f"{names.RELEASED}/{_DIGITS.sub('', deletion.at)}-{deletion.id}.json"


def _record(store: Store, deletion: Deletion) -> None:
    put_record(store, names.deletion(deletion.what, deletion.id), deletion)
