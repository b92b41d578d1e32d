"""Records of datasets in the store: read, and appended to."""

from __future__ import annotations

from functools import partial
from typing import Literal

from service.model import names
from service.model.clock import timestamp
from service.model.dataset_records import DatasetEvent, DatasetRecord, Snapshot
from service.model.errors import NotFoundError
from service.store.records import Put, put_record, read_record
from service.store.store import Store


def load_dataset(store: Store, name: str) -> DatasetRecord:
    """The record of a dataset; NotFoundError if there is none."""
    return read_record(DatasetRecord, store, names.dataset_record(name))


def dataset_events(store: Store, name: str) -> list[DatasetEvent]:
    """What users did to a dataset, in order."""
    keys = sorted(entry.key for entry in store.list(names.dataset_events(name)))
    return [read_record(DatasetEvent, store, key) for key in keys]


def add_dataset_event(
    store: Store, name: str, what: Literal["cancelled", "retried"], *, put: Put | None = None
) -> DatasetEvent:
    """Append an event after those there are."""
    put = put or partial(put_record, store)
    while True:
        taken = [event.number for event in dataset_events(store, name)]
        event = DatasetEvent(number=max(taken, default=0) + 1, what=what, at=timestamp())
        if put(names.dataset_event(name, event.number, what), event):
            return event


def load_snapshot(store: Store, dataset: str, digest: str) -> Snapshot:
    """A snapshot; NotFoundError if there is none."""
    return read_record(Snapshot, store, names.dataset_snapshot(dataset, digest))


def newest_snapshot(store: Store, dataset: str, digest: str | None = None) -> Snapshot:
    """The newest snapshot of a dataset, or the one with a digest; NotFoundError if there is none."""
    if digest is not None:
        return load_snapshot(store, dataset, digest)
    taken = [read_record(Snapshot, store, entry.key) for entry in store.list(names.dataset_snapshots(dataset))]
    if not taken:
        raise NotFoundError(f"dataset {dataset!r} has no snapshot; `graspd datasets snapshot {dataset}` takes one")
    return max(taken, key=lambda one: (one.created, one.digest))
