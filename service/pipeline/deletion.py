"""What a user takes away: assets, jobs, datasets. A record of the deletion is the fact; the rest follows.

`deletions/{what}/{id}.json` is written while nobody else writes the index, in the same step as the rows go. From then
on the thing is gone: a rebuild leaves it out, and nothing of that id is taken in. The keeper
(`service.pipeline.sweeper`) removes the objects behind it, then the record itself; killed at any moment, it begins
again.
"""

from __future__ import annotations

from service.model import names
from service.model.clock import timestamp
from service.model.errors import ConflictError, DamagedError, NotFoundError
from service.model.projects import EVERYTHING, Reach
from service.model.records import JobRecord
from service.model.states import AssetKind
from service.pipeline.backends import Parts
from service.pipeline.recording import recording
from service.store.deletions import Deletion
from service.store.records import Put, read_record


def delete_asset(parts: Parts, kind: AssetKind, name: str, *, owner: str = "", reach: Reach = EVERYTHING) -> None:
    """Take a hand, object or network away.

    Args:
        owner: id of the API key that deletes it.
        reach: what a refusal may name.

    Raises:
        NotFoundError: there is none of that name or digest.
        ConflictError: it comes with graspd, or a job, a dataset or a set of objects needs it.
    """
    asset = parts.index.assets.get(kind, name)
    if asset.builtin:
        raise ConflictError(f"the {kind.value} {asset.name!r} comes with graspd and cannot be deleted")
    with recording(parts) as (connection, put):
        if user := parts.index.removals.user_of_asset(asset, within=connection):
            if asset.shared and not reach.everything:
                user = "a job, a dataset or a set of objects"
            raise ConflictError(f"the {kind.value} {asset.name!r} is needed by {user}; delete that first")
        _record(put, Deletion(what=kind.value, id=asset.digest, at=timestamp(), owner=owner))
        parts.index.removals.remove_asset(kind, asset.digest, within=connection)


def delete_job(parts: Parts, job_id: str, *, owner: str = "") -> None:
    """Take a job away; its shards, where no other job needs them, follow after a grace time.

    Raises:
        NotFoundError: there is no such job.
        ConflictError: it has not ended, or a dataset holds it.
    """
    parts.index.jobs.get(job_id)
    try:
        record = read_record(JobRecord, parts.store, names.job_record(job_id))
    except (NotFoundError, DamagedError):
        record = None  # then its shards cannot be told, and stay
    with recording(parts) as (connection, put):
        if user := parts.index.removals.user_of_job(job_id, within=connection):
            raise ConflictError(f"job {job_id} {user}")
        attempts = parts.index.removals.attempts_of(job_id, within=connection)
        deletion = Deletion(what="job", id=job_id, at=timestamp(), owner=owner, job=record, attempts=attempts)
        _record(put, deletion)
        parts.index.removals.remove_job(job_id, within=connection)


def delete_dataset(parts: Parts, name: str, *, owner: str = "") -> None:
    """Take a dataset away with its snapshots; those of its jobs follow that were planned for it alone.

    Raises:
        NotFoundError: there is no such dataset.
        ConflictError: it has not ended.
    """
    dataset = parts.index.datasets.get(name)
    if not dataset.state.is_final:
        raise ConflictError(f"dataset {name!r} is {dataset.state}; cancel it first: graspd datasets cancel {name}")
    with recording(parts) as (connection, put):
        _record(put, Deletion(what="dataset", id=name, at=timestamp(), owner=owner))
        parts.index.removals.remove_dataset(name, within=connection)


def _record(put: Put, deletion: Deletion) -> None:
    put(names.deletion(deletion.what, deletion.id), deletion)
