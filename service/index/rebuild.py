"""The index from the store alone, and how a live index differs from that."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Final

from sqlalchemy import Connection, Table, delete, select

from service import names
from service.datasets.records import DatasetRecord, ObjectSet, Snapshot, dataset_events
from service.domain import State
from service.index.index import Index
from service.index.tables import LIVE_COLUMNS, LIVE_TABLES, metadata
from service.library import load_asset, load_check, stored_assets
from service.manifests import ShardManifest
from service.records import AttemptRecord, JobRecord, job_events, parse_record
from service.store import Store

#: Reads in flight: what hides the latency of a remote store.
_READERS: Final = 16
_SHOWN_DIFFERENCES: Final = 50


def rebuild(index: Index, store: Store, *, progress: Callable[[str, int], None] | None = None) -> dict[str, int]:
    """Replace all rows by what follows from the store. The old rows stay until all new ones are there.

    Args:
        progress: called with what is being read and how many of it there were so far.

    Returns:
        number of jobs, attempts, shards, assets, datasets, snapshots and object sets read.
    """
    counts = dict.fromkeys(("assets", "jobs", "attempts", "shards", "datasets", "snapshots", "object_sets"), 0)

    def count(what: str) -> None:
        counts[what] += 1
        if progress is not None:
            progress(what, counts[what])

    with index.writing() as connection:
        for table in metadata.tables.values():
            if table.name not in LIVE_TABLES:
                connection.execute(delete(table))
        for asset in _assets(store):
            index.add_asset(*asset, within=connection)
            count("assets")
        jobs = list(_records(JobRecord, store, names.JOBS, "/job.json"))
        for record in jobs:
            index.add_job(record, within=connection)
            count("jobs")
        for attempt in sorted(_records(AttemptRecord, store, names.TASKS, ".json"), key=lambda a: a.number):
            index.add_attempt(attempt, within=connection)
            count("attempts")
        for record in jobs:
            if events := job_events(store, record.id):
                index.set_job_events(record.id, events, within=connection)
        for manifest in _records(ShardManifest, store, names.SHARDS, ".json"):
            index.add_manifests([manifest], within=connection)
            count("shards")
        _rebuild_datasets(index, store, connection, count)
    return counts


def _rebuild_datasets(index: Index, store: Store, connection: Connection, count: Callable[[str], None]) -> None:
    for record in _records(DatasetRecord, store, names.DATASETS, "/dataset.json"):
        index.add_dataset(record, within=connection)
        if events := dataset_events(store, record.name):
            index.set_dataset_events(record.name, events, within=connection)
        count("datasets")
    for entry in list(store.list(names.DATASETS)):
        if "/snapshots/" in entry.key:
            index.add_snapshot(parse_record(Snapshot, store.get(entry.key), entry.key), within=connection)
            count("snapshots")
    for found in _records(ObjectSet, store, names.OBJECT_SETS, ".json"):
        index.add_object_set(found, within=connection)
        count("object_sets")


def differences(index: Index, store: Store) -> list[str]:
    """What `rebuild` would change, one line a row; empty if the index is what the store says."""
    with tempfile.TemporaryDirectory(prefix="graspd-index-") as folder:
        fresh = Index(f"sqlite:///{Path(folder) / 'index.sqlite'}")
        try:
            rebuild(fresh, store)
            with index.reading() as live, fresh.reading() as derived:
                return [line for table in metadata.tables.values() for line in _compare(table, live, derived)][
                    :_SHOWN_DIFFERENCES
                ]
        finally:
            fresh.close()


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
                    yield f"{name}: {column} is {ours[key][column]!r}, the store says {theirs[key][column]!r}"


def _rows(table: Table, connection: Connection) -> dict[tuple[Any, ...], dict[str, Any]]:
    keys = [column.name for column in table.primary_key]
    columns = [column for column in table.columns if column.name not in LIVE_COLUMNS]
    rows = {}
    for row in connection.execute(select(*columns)).mappings():
        rows[tuple(row[key] for key in keys)] = _lasting(dict(row))
    return rows


def _lasting(row: dict[str, Any]) -> dict[str, Any]:
    """A row without what only the present moment knows: that a task is running, and where."""
    if row.get("state") == State.RUNNING.value:
        row["state"] = State.QUEUED.value
    if row.get("state") == State.QUEUED.value and "worker" in row:
        row["worker"] = None
    if "verdict" in row:  # attempts of a check are not kept in the store: it either ends in a finding or is repeated
        row["last_attempt"] = 0
    return row


def _assets(store: Store) -> Iterator[tuple[Any, Any]]:
    for kind, digest in stored_assets(store):
        yield load_asset(store, kind, digest), load_check(store, kind, digest)


def _records(model: type[Any], store: Store, prefix: str, suffix: str) -> Iterable[Any]:
    keys = [entry.key for entry in store.list(prefix) if entry.key.endswith(suffix)]
    if prefix == names.JOBS:
        keys = [key for key in keys if key.count("/") == 2]
    with ThreadPoolExecutor(_READERS) as pool:
        for key, data in zip(keys, pool.map(store.get, keys), strict=True):
            yield parse_record(model, data, key)
