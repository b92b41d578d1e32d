"""Rebuild of the index from the store, and differences between an index and the store."""

import logging
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any, Final, TypeVar

from sqlalchemy import Connection, Table, delete, select, update
from sqlalchemy.exc import DataError

from graspd.service.index.changes.records import QUIET
from graspd.service.index.index import Index
from graspd.service.index.notes import StoreMark
from graspd.service.index.outbox import last_end_number
from graspd.service.index.tables import LIVE_COLUMNS, LIVE_TABLES, datasets, jobs, metadata, shards, webhooks
from graspd.service.model import names, records
from graspd.service.model.errors import DamagedError, InputError, NotFoundError
from graspd.service.model.states import State
from graspd.service.model.webhooks import Webhook
from graspd.service.settings import sqlite_url
from graspd.service.store.library import load_asset, load_check, stored_assets
from graspd.service.store.manifests import ShardManifest
from graspd.service.store.records import newest_mark, parse_record, pending_deletions
from graspd.service.store.store import Store

log = logging.getLogger(__name__)
RecordT = TypeVar("RecordT", bound=records.Record)
#: Errors of an invalid record, when it is read or written to the database. An unavailable backend raises other errors.
_OF_THE_RECORD: Final = (DamagedError, InputError, DataError, ValueError, TypeError, LookupError, ArithmeticError)
_READERS: Final = 16
_SHOWN_DIFFERENCES: Final = 50
#: Called with the kind of records and the number read so far.
Progress = Callable[[str, int], object]


def rebuild(index: Index, store: Store, *, progress: Progress = lambda what, number: None) -> dict[str, int]:
    """Replace all rows by rows derived from the store, in one transaction; return record counts by kind.

    `left_out` counts damaged records. The log names all of them, `index.notes` the first 50.
    """
    with index.database.write_transaction() as connection:
        connection.execution_options(**{QUIET: True})
        made = _Rebuild(index, store, connection, progress)
        for table in metadata.tables.values():
            if table.name not in LIVE_TABLES:
                connection.execute(delete(table))
        index.notes.set_store_mark(StoreMark(mark := newest_mark(store), mark), within=connection)
        made.add_assets()
        made.add_jobs()
        made.add_shards()
        made.add_datasets()
        made.add_webhooks()
        made.add_tags()
        index.notes.set_complete(made.left_out, within=connection)
    return {**made.counts, "left_out": len(made.left_out)}


class _Rebuild:
    """Rebuild in one transaction, with one savepoint per record: an invalid record leaves no rows."""

    def __init__(self, index: Index, store: Store, connection: Connection, progress: Progress) -> None:
        self._index, self._store, self._connection, self._progress = index, store, connection, progress
        self.counts = dict.fromkeys(("assets", "jobs", "attempts", "shards", "datasets", "snapshots", "object_sets"), 0)
        self.left_out: list[str] = []
        self._gone = pending_deletions(store)
        self._last = last_end_number(connection)
        self._seen = {row.id: row.seen for row in connection.execute(select(webhooks))}
        self._told = {row.name: row.told for row in connection.execute(select(datasets))}

    def add_assets(self) -> None:
        for kind, digest in stored_assets(self._store):
            with self._skip_invalid(names.asset_key(kind, digest, "check.json")):
                check = load_check(self._store, kind, digest)
                with self._skip_invalid(names.asset_key(kind, digest, "asset.json"), "assets"):
                    self._index.write.add_asset(load_asset(self._store, kind, digest), check, within=self._connection)

    def add_jobs(self) -> None:
        """Add jobs, then failed attempts by number, then events."""
        known = []
        for key, data in self._read_records(names.JOBS, lambda key: key.endswith("/job.json") and key.count("/") == 2):
            with self._skip_invalid(key, "jobs"):
                record = parse_record(records.JobRecord, data, key)
                self._index.write.add_job(record, within=self._connection)
                known.append(record.id)
        attempts = self._parse_records(records.AttemptRecord, names.TASKS)
        for attempt in sorted(attempts, key=lambda attempt: attempt.number):
            with self._skip_invalid(names.attempt_key(attempt.task_id, attempt.number), "attempts"):
                self._index.write.add_attempt(attempt, within=self._connection)
        for job in known:
            if events := self._parse_records(records.JobEvent, names.job_events_folder(job)):
                self._index.write.set_job_events(job, events, within=self._connection)

    def add_shards(self) -> None:
        for key, data in self._read_records(names.SHARDS):
            with self._skip_invalid(key, "shards"):
                self._index.write.add_manifests([parse_record(ShardManifest, data, key)], within=self._connection)

    def add_datasets(self) -> None:
        for key, data in self._read_records(names.DATASETS, lambda key: key.endswith("/dataset.json")):
            with self._skip_invalid(key, "datasets"):
                record = parse_record(records.DatasetRecord, data, key)
                self._index.write_dataset.add(record, within=self._connection)
                if events := self._parse_records(records.DatasetEvent, names.dataset_events_folder(record.name)):
                    self._index.write_dataset.set_events(record.name, events, within=self._connection)
        told = self._index.datasets.ended_event_counts(within=self._connection) | self._told
        for name, events in told.items():
            self._connection.execute(update(datasets).where(datasets.c.name == name).values(told=events))
        for key, data in self._read_records(names.DATASETS, lambda key: "/snapshots/" in key):
            with self._skip_invalid(key, "snapshots"):
                self._index.write_dataset.add_snapshot(
                    parse_record(records.Snapshot, data, key), within=self._connection
                )
        for key, data in self._read_records(names.OBJECT_SETS):
            with self._skip_invalid(key, "object_sets"):
                self._index.write_dataset.add_object_set(
                    parse_record(records.ObjectSet, data, key), within=self._connection
                )

    def add_webhooks(self) -> None:
        for key, data in self._read_records(names.WEBHOOKS):
            with self._skip_invalid(key):
                hook = parse_record(Webhook, data, key)
                self._index.outbox.add(hook, seen=self._seen.get(hook.id, self._last), within=self._connection)

    def add_tags(self) -> None:
        """Add the last version of each tag; earlier versions remain in the store after interrupted changes."""
        last = {key.rpartition("/")[0]: (key, data) for key, data in sorted(self._read_records(names.TAGS))}
        for key, data in last.values():
            with self._skip_invalid(key):
                self._index.tags.put(parse_record(records.Tag, data, key), within=self._connection)

    def _parse_records(self, model: type[RecordT], prefix: str) -> list[RecordT]:
        found = []
        for key, data in sorted(self._read_records(prefix)):
            with self._skip_invalid(key):
                found.append(parse_record(model, data, key))
        return found

    def _read_records(
        self, prefix: str, wanted: Callable[[str], bool] = lambda key: key.endswith(".json")
    ) -> Iterator[tuple[str, bytes]]:
        """Yield key and bytes of each record below a prefix, except those of deleted jobs and datasets."""
        listed = (entry.key for entry in self._store.list(prefix))
        keys = [key for key in listed if wanted(key) and not self._is_deleted(key)]
        with ThreadPoolExecutor(_READERS) as pool:
            for key, data in zip(keys, pool.map(self._read_bytes, keys), strict=True):
                if data is not None:
                    yield key, data

    def _is_deleted(self, key: str) -> bool:
        folder, _, rest = key.partition("/")
        what = {names.JOBS: "job", names.DATASETS: "dataset"}.get(folder, "")
        return (what, rest.partition("/")[0]) in self._gone

    def _read_bytes(self, key: str) -> bytes | None:
        """Return the bytes of a record; None if it was removed since the listing."""
        with suppress(NotFoundError):
            return self._store.get(key)
        return None

    @contextmanager
    def _skip_invalid(self, key: str, what: str | None = None) -> Iterator[None]:
        try:
            with self._connection.begin_nested():
                yield
        except _OF_THE_RECORD as error:
            self.left_out.append(key)
            log.warning("%s is not entered into the index: %s", key, error)
            return
        if what is not None:
            self.counts[what] += 1
            self._progress(what, self.counts[what])


def mark_complete_if_new(index: Index, store: Store) -> None:
    """Mark an index of unknown completeness as complete if the store has no jobs and no datasets."""
    if index.notes.completeness() is None and not any(any(store.list(key)) for key in (names.JOBS, names.DATASETS)):
        index.notes.set_complete()


def differences(index: Index, store: Store) -> list[str]:
    """Return at most 50 lines: damaged records, then rows that `rebuild` would change."""
    with (
        tempfile.TemporaryDirectory(prefix="graspd-index-") as folder,
        closing(Index(sqlite_url(Path(folder) / "index.sqlite"))) as fresh,
    ):
        rebuild(fresh, store)
        made = fresh.notes.completeness()
        damaged = [f"{name}: damaged, so not in the index" for name in made.names] if made is not None else []
        with index.database.read_transaction() as live, fresh.database.read_transaction() as derived:
            rows = [line for table in metadata.tables.values() for line in _compare(table, live, derived)]
        return [*damaged, *rows][:_SHOWN_DIFFERENCES]


def missing_names(index: Index, store: Store) -> list[str]:
    """Return one line per shard or job that only the index or only the store has, without reading records."""
    gone = {f"jobs {name}" for what, name in pending_deletions(store) if what == "job"}
    stored = {
        f"shards {entry.key.rpartition('/')[2].removesuffix('.json')}"
        for entry in store.list(names.SHARDS)
        if entry.key.endswith(".json")
    }
    stored |= {f"jobs {entry.key.split('/')[1]}" for entry in store.list(names.JOBS) if entry.key.endswith("/job.json")}
    with index.database.read_transaction() as connection:
        rows = {f"{table.name} {one}" for table in (shards, jobs) for one in connection.scalars(select(table.c.id))}
    return [f"{name}: not in the {'index' if name in stored else 'store'}" for name in sorted((rows ^ stored) - gone)]


def _compare(table: Table, live: Connection, derived: Connection) -> Iterator[str]:
    if table.name in LIVE_TABLES:
        return
    ours, theirs = _rows(table, live), _rows(table, derived)
    for key in sorted(ours.keys() | theirs.keys(), key=str):
        name = f"{table.name} {' '.join(map(str, key))}"
        if key not in theirs:
            yield f"{name}: not in the store"
        elif key not in ours:
            yield f"{name}: not in the index"
        else:
            for column in ours[key]:
                if ours[key][column] != theirs[key][column]:
                    yield f"{name}: {column} is {ours[key][column]!r}, in the store {theirs[key][column]!r}"


def _rows(table: Table, connection: Connection) -> dict[tuple[Any, ...], dict[str, Any]]:
    keys = [column.name for column in table.primary_key]
    columns = [column for column in table.columns if column.name not in LIVE_COLUMNS]
    rows = connection.execute(select(*columns)).mappings()
    return {tuple(row[key] for key in keys): _without_run_state(dict(row)) for row in rows}


def _without_run_state(row: dict[str, Any]) -> dict[str, Any]:
    """Remove current state: running becomes queued, and a queued or cancelled task has no worker."""
    if row.get("state") == State.RUNNING.value:
        row["state"] = State.QUEUED.value
    if row.get("state") in (State.QUEUED.value, State.CANCELLED.value) and "worker" in row:
        row["worker"] = None
    if "verdict" in row:  # The store does not contain attempts of a check.
        row["last_attempt"] = 0
        if row["verdict"] is None:
            row["message"] = None
    return row
