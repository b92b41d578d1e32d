"""Deletion of assets, jobs and datasets by users, and the garbage collector of the store.

A deletion writes `deletions/{what}/{id}.json` and removes the rows in one transaction. The resource then no longer
exists: rebuilds omit it, and requests with its id are refused. The garbage collector of the controller then moves the
stored objects below `removed/` and deletes that record. After the grace time it deletes these objects, and the shards
that no job needs. It can resume after a kill.
"""

import contextlib
import logging
import time
from collections.abc import Callable, Collection, Iterable, Iterator
from typing import Any, Final, TypeVar

from sqlalchemy import Connection

from graspd.service.index.changes.records import QUIET
from graspd.service.index.database import chunks
from graspd.service.model import names
from graspd.service.model.clock import timestamp
from graspd.service.model.errors import ConflictError, DamagedError, NotFoundError
from graspd.service.model.planning import plan_tasks
from graspd.service.model.projects import EVERYTHING, ProjectScope
from graspd.service.model.records import AttemptRecord, JobRecord, Record, Snapshot, Tag
from graspd.service.model.states import AssetKind, Stage
from graspd.service.pipeline import job_actions, tagging
from graspd.service.pipeline.backends import Services, record_transaction
from graspd.service.store import records
from graspd.service.store.library import load_asset, load_check

log = logging.getLogger(__name__)
RecordT = TypeVar("RecordT", bound=Record)
BUDGET_S: Final = 0.5
#: Time [s] for which a refused upload is stored, so that a form can check it again with other options.
REFUSED_S: Final = 3600.0
_AT_ONCE: Final = 200


def delete_asset(
    services: Services, kind: AssetKind, name: str, *, owner: str = "", scope: ProjectScope = EVERYTHING
) -> None:
    """Delete a hand, object or network; error messages name only resources in `scope`.

    ConflictError: the asset is built in, or a job, a dataset or a set of objects needs it.
    """
    asset = services.index.assets.get(kind, name)
    if asset.builtin:
        raise ConflictError(f"the {kind.value} {asset.name!r} comes with graspd and cannot be deleted")
    with record_transaction(services) as (connection, put):
        if user := services.index.removals.reason_to_keep_asset(asset, within=connection):
            if asset.shared and not scope.everything:
                user = "a job, a dataset or a set of objects"
            raise ConflictError(f"the {kind.value} {asset.name!r} is needed by {user}; delete that first")
        about = {"name": asset.name, "submitter": asset.owner, "project": asset.project}
        _put_deletion(put, what=kind.value, id=asset.digest, owner=owner, **about)
        services.index.removals.remove_asset(kind, asset.digest, within=connection)


def delete_job(services: Services, job_id: str, *, owner: str = "") -> None:
    """Delete a job, and later the shards only it needs; ConflictError: unfinished or in a dataset."""
    job = services.index.jobs.get(job_id)
    try:
        record = records.read_record(JobRecord, services.store, names.job_record_key(job_id))
    except (NotFoundError, DamagedError):
        record = None  # The shards of an unreadable record are unknown, so they stay.
    with record_transaction(services) as (connection, put):
        if user := services.index.removals.reason_to_keep_job(job_id, within=connection):
            raise ConflictError(f"job {job_id} {user}")
        attempts = services.index.removals.attempts_of(job_id, within=connection)
        about = {"name": f"{job.request.hand} on {job.request.object}", "submitter": job.owner, "project": job.project}
        _put_deletion(put, what="job", id=job_id, owner=owner, job=record, attempts=attempts, **about)
        services.index.removals.remove_job(job_id, within=connection)


def delete_dataset(services: Services, name: str, *, owner: str = "", with_snapshots: bool = False) -> None:
    """Delete a dataset and the jobs that only it needs; ConflictError: it is unfinished or has snapshots."""
    dataset = services.index.datasets.get(name)
    if not dataset.state.is_final:
        raise ConflictError(f"dataset {name!r} is {dataset.state}; cancel it first: graspd datasets cancel {name}")
    with record_transaction(services) as (connection, put):
        taken = services.index.removals.count_snapshots(name, within=connection)
        if taken and not with_snapshots:
            raise ConflictError(
                f"dataset {name!r} has {taken} snapshot{'s' * (taken > 1)}, which papers and training runs may name; "
                f"to delete them too: graspd datasets delete {name} --with-snapshots"
            )
        _put_deletion(put, what="dataset", id=name, owner=owner, submitter=dataset.owner, project=dataset.project)
        services.index.removals.remove_dataset(name, within=connection)


def move_to_removed(services: Services, deletion: records.Deletion) -> None:
    """Move a deleted resource's stored objects below `removed/`, record last, unless it was restored."""
    record = _record_key(deletion)
    with services.index.database.write_transaction():
        if not services.store.exists(names.deletion_key(deletion.what, deletion.id)):
            return
        folder = records.removed_folder(deletion)
        records.put_record(services.store, f"{folder}/deletion.json", deletion)
        if deletion.job is not None:
            records.put_record(
                services.store, records.released_key(deletion), records.DeletedJob(at=deletion.at, job=deletion.job)
            )
        attempts = [names.attempt_key(task, number) for task, number in deletion.attempts]
        for key in [*attempts, *_record_last(services.store.keys(record.rpartition("/")[0]), record)]:
            services.store.move(key, f"{folder}/{key}")
        services.store.delete(names.deletion_key(deletion.what, deletion.id))


def restore(
    services: Services,
    what: records.What,
    name: str,
    *,
    permit: Callable[[records.Deletion], None],
    among: Callable[[records.Deletion], bool] = lambda _: True,
) -> records.Deletion:
    """Restore a deleted resource by name or id; a dataset is restored with its deleted jobs.

    `permit` raises if the user may not restore it; `among` tests the scope. NotFoundError: nothing of this name was
    deleted within the grace time. ConflictError: the name is in use again, or an asset that it needs is deleted.
    """
    known = [
        one for one in records.restorable_deletions(services.store, what) if name in (one.id, one.name) and among(one)
    ]
    if not known:
        days = services.settings.shard_grace_s / 86400
        raise NotFoundError(f"no {what} {name!r} was deleted in the last {days:.3g} days")
    permit(known[0])
    if what == "tag":
        _restore_tag(services, known[0])
        return known[0]
    with services.index.database.write_transaction() as connection:
        connection.execution_options(**{QUIET: True})
        _restore(services, known[0], connection)
    return known[0]


def _restore(services: Services, deletion: records.Deletion, connection: Connection) -> None:
    """Restore stored objects, then rows, then remove the deletion record; call within a write transaction."""
    store, record, folder = services.store, _record_key(deletion), records.removed_folder(deletion)
    waiting = names.deletion_key(deletion.what, deletion.id)
    if not store.exists(waiting) and store.exists(record):
        called = deletion.id if deletion.what in ("job", "dataset") else deletion.name
        raise ConflictError(f"there is a {deletion.what} {called!r} again; delete that first")
    moved = [key.removeprefix(f"{folder}/") for key in store.keys(folder)]
    for key in _record_last([key for key in moved if key != "deletion.json"], record):
        store.move(f"{folder}/{key}", key)
    try:
        if deletion.what == "dataset":
            _restore_jobs(services, deletion, connection)
        _restore_rows(services, deletion, connection)
    except ConflictError:
        if not store.exists(waiting):
            records.put_record(store, waiting, deletion)  # The garbage collector will move the objects again.
        raise
    store.delete(waiting)
    store.delete(f"{folder}/deletion.json")


def _restore_rows(services: Services, deletion: records.Deletion, connection: Connection) -> None:
    """Write the rows that follow from the records of a job, dataset, hand, object or network."""
    store, index = services.store, services.index
    if deletion.what == "job":
        record = records.read_record(JobRecord, store, names.job_record_key(deletion.id))
        _require_assets(services, record.assets, connection)
        index.write.add_job(record, within=connection)
        tried = [records.read_record(AttemptRecord, store, names.attempt_key(*one)) for one in deletion.attempts]
        for attempt in sorted(tried, key=lambda one: one.number):
            index.write.add_attempt(attempt, within=connection)
        if events := records.job_events(store, record.id):
            index.write.set_job_events(record.id, events, within=connection)
    elif deletion.what == "dataset":
        dataset = records.load_dataset(store, deletion.id)
        members = [(AssetKind.HAND, one.digest) for one in dataset.hands]
        _require_assets(services, [*members, *((AssetKind.OBJECT, one.digest) for one in dataset.objects)], connection)
        index.write_dataset.add(dataset, within=connection)
        actions = records.dataset_events(store, dataset.name)
        index.write_dataset.set_events(dataset.name, actions, within=connection)
        # Only ended datasets are deleted: the end was reported before.
        told = max((action.number for action in actions), default=0)
        index.write_dataset.set_progress(dataset.name, told=told, within=connection)
        for key in store.keys(names.dataset_snapshots_folder(dataset.name)):
            index.write_dataset.add_snapshot(records.read_record(Snapshot, store, key), within=connection)
    else:
        kind = AssetKind(deletion.what)
        asset = load_asset(store, kind, deletion.id)
        with contextlib.suppress(NotFoundError):
            other = index.assets.get(kind, asset.name, scope=ProjectScope(asset.project, everything=False))
            if other.verdict != "refuse" and other.digest != asset.digest:
                raise ConflictError(f"there is another {kind.value} named {asset.name!r} now; delete that first")
        index.write.add_asset(asset, load_check(store, kind, asset.digest), within=connection)


def _restore_jobs(services: Services, deletion: records.Deletion, connection: Connection) -> None:
    """Restore the jobs of a dataset that were deleted with it or later."""
    wanted = set(records.load_dataset(services.store, deletion.id).jobs)
    newest: dict[str, records.Deletion] = {}
    for one in records.restorable_deletions(services.store, "job"):
        if one.id in wanted and one.at >= deletion.at:
            newest.setdefault(one.id, one)
    for one in newest.values():
        is_waiting = services.store.exists(names.deletion_key("job", one.id))
        if is_waiting or not services.store.exists(names.job_record_key(one.id)):
            _restore(services, one, connection)


def _restore_tag(services: Services, deletion: records.Deletion) -> None:
    folder = records.removed_folder(deletion)
    key = next(key for key in services.store.keys(folder) if not key.endswith("/deletion.json"))
    tagging.restore_tag(services, records.read_record(Tag, services.store, key))
    for done in (key, f"{folder}/deletion.json"):
        services.store.delete(done)


def _require_assets(services: Services, wanted: Collection[tuple[AssetKind, str]], connection: Connection) -> None:
    if missing := services.index.assets.missing(wanted, within=connection):
        kind = missing[0].partition(" ")[0]
        raise ConflictError(f"it needs the {missing[0]}, which was deleted too; first run `graspd {kind}s restore`")


def _record_key(deletion: records.Deletion) -> str:
    """Return the key of the record whose presence makes the resource exist."""
    if deletion.what == "job":
        return names.job_record_key(deletion.id)
    if deletion.what == "dataset":
        return names.dataset_record_key(deletion.id)
    return names.asset_key(AssetKind(deletion.what), deletion.id, "asset.json")


def _record_last(keys: Iterable[str], record: str) -> list[str]:
    return sorted(keys, key=lambda key: (key == record, key))


def _put_deletion(put: records.Put, **values: Any) -> None:
    deletion = records.Deletion(at=timestamp(), **values)
    put(names.deletion_key(deletion.what, deletion.id), deletion)


class GarbageCollector:
    """Executes deletions, and deletes stored objects whose grace time is over."""

    def __init__(self, services: Services, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._services = services
        self._clock = clock

    def execute_deletions(self, budget_s: float = BUDGET_S) -> bool:
        """Execute deletions for about `budget_s` [s]; return whether work is left."""
        deadline = self._clock() + budget_s
        for _, deletion in self._read_records(records.Deletion, names.DELETIONS):
            if self._clock() > deadline or not self._execute(deletion, deadline):
                return True
            log.info("the stored objects of %s %s are moved to removed/", deletion.what, deletion.id)
        return False

    def collect(self, budget_s: float = BUDGET_S) -> bool:
        """Delete refused uploads, expired objects and unneeded shards; return whether work is left."""
        deadline = self._clock() + budget_s
        if self._delete_refused(deadline):
            return True
        before = timestamp(self._services.settings.shard_grace_s)
        # The record of a deletion is deleted last.
        for key in sorted(self._services.store.keys(names.REMOVED), key=lambda key: key.endswith("/deletion.json")):
            if self._clock() > deadline:
                return True
            if records.is_removed_before(key, before):
                self._services.store.delete(key)
        known = self._services.index.notes.completeness()
        if known is not None and known.left_out:
            return False  # A job with an unreadable record may need one of these shards.
        for key, released in self._read_records(records.DeletedJob, names.RELEASED):
            if released.at > before:
                break  # The keys begin with the time, so all further records are younger.
            for stage, shard in self._unneeded_shards(released):
                if self._clock() > deadline:
                    return True
                with self._services.index.database.write_transaction() as connection:
                    if self._services.index.removals.remove_shard(shard, within=connection):
                        self._services.store.delete(names.shard_manifest_key(stage, shard))
                        self._services.store.delete(names.shard_file_key(stage, shard))
            self._services.store.delete(key)
        return False

    def _delete_refused(self, deadline: float) -> bool:
        """Delete refused uploads after `REFUSED_S`, unless a job needs them; return whether work is left."""
        store, index = self._services.store, self._services.index
        for asset in index.assets.refused(before=timestamp(REFUSED_S)):
            if self._clock() > deadline:
                return True
            record = names.asset_key(asset.kind, asset.digest, "asset.json")
            with index.database.write_transaction() as connection:
                if index.removals.reason_to_keep_asset(asset, within=connection):
                    continue
                for key in _record_last(store.keys(record.rpartition("/")[0]), record):
                    store.delete(key)
                index.removals.remove_asset(asset.kind, asset.digest, within=connection)
            log.info("the refused %s %s is deleted", asset.kind.value, asset.name)
        return False

    def _read_records(self, model: type[RecordT], folder: str) -> Iterator[tuple[str, RecordT]]:
        """Yield key and content of the readable records below a folder, ordered by key."""
        for key in self._services.store.keys(folder):
            try:
                yield key, records.read_record(model, self._services.store, key)
            except DamagedError as error:
                log.warning("%s", error)

    def _execute(self, deletion: records.Deletion, deadline: float) -> bool:
        """Remove rows and move stored objects of a deleted resource; return whether all is done."""
        with self._services.index.database.write_transaction() as connection:
            if not self._services.store.exists(names.deletion_key(deletion.what, deletion.id)):
                return True  # The resource was restored meanwhile.
            removals = self._services.index.removals
            if deletion.what == "job":
                removals.remove_job(deletion.id, within=connection)
            elif deletion.what == "dataset":
                removals.remove_dataset(deletion.id, within=connection)
            else:
                removals.remove_asset(AssetKind(deletion.what), deletion.id, within=connection)
        if deletion.what == "dataset" and not self._remove_jobs_of(deletion.id, deadline):
            return False
        move_to_removed(self._services, deletion)
        return True

    def _remove_jobs_of(self, dataset: str, deadline: float) -> bool:
        """Delete jobs planned for this dataset that are in no other; return whether all are deleted."""
        try:
            jobs = records.load_dataset(self._services.store, dataset).jobs
        except (NotFoundError, DamagedError):
            return True
        for some in chunks(jobs, _AT_ONCE):
            for job in self._services.index.removals.orphaned_dataset_jobs(some):
                if self._clock() > deadline:
                    return False
                try:
                    # The jobs of a recently cancelled dataset may still be unfinished.
                    with contextlib.suppress(ConflictError):
                        job_actions.cancel(self._services, job)
                    delete_job(self._services, job)
                except (ConflictError, NotFoundError) as error:
                    log.info("job %s of the deleted dataset %s stays: %s", job, dataset, error)
        return True

    def _unneeded_shards(self, released: records.DeletedJob) -> Iterator[tuple[Stage, str]]:
        planned = [(task.stage, task.output) for task in plan_tasks(released.job)]
        for some in chunks(planned, _AT_ONCE):
            unneeded = self._services.index.removals.unneeded_shards([shard for _, shard in some])
            yield from ((stage, shard) for stage, shard in some if shard in unneeded)
