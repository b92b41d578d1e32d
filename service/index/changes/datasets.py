"""Changes of the index on datasets. Each is idempotent."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy import Connection, update

from service.index.bulk import upsert
from service.index.changes.rows import beside
from service.index.database import Database
from service.index.dataset_tables import dataset_cells, dataset_snapshots, datasets, object_sets
from service.model.dataset_records import DatasetEvent, DatasetRecord, ObjectSet, Snapshot


@dataclass(frozen=True)
class DatasetChanges:
    """Writes on datasets. `within` makes a write part of a larger transaction."""

    database: Database

    def add(self, record: DatasetRecord, *, within: Connection | None = None) -> None:
        """A dataset with its cells; what users did to it later stays as it is."""
        row = {
            "name": record.name,
            "digest": record.digest,
            "hands": [member.model_dump() for member in record.hands],
            "objects": [member.model_dump() for member in record.objects],
            "options": record.options.model_dump(mode="json"),
            "revisions": record.revisions,
            "cells": len(record.jobs),
            "created": record.created,
            "owner": record.owner,
            "project": record.project,
            "cancelled": False,
            "events": 0,
            "applied": 0,
            "planned": False,
            "neighbours": beside(record.options),
            "network_digest": record.options.network,
        }
        cells = [
            {
                "dataset": record.name,
                "position": cell.position,
                "hand": cell.hand.name,
                "object": cell.object.name,
                "hand_digest": cell.hand.digest,
                "object_digest": cell.object.digest,
                "job_id": cell.job_id,
                "fidelity": cell.fidelity or None,
                "choice": cell.choice and cell.choice.model_dump(),
            }
            for cell in record.cells()
        ]
        with self.database.writing(within) as connection:
            upsert(connection, datasets, [row], keep=("cancelled", "events", "applied", "planned"))
            upsert(connection, dataset_cells, cells)

    def set_events(self, name: str, events: Sequence[DatasetEvent], *, within: Connection | None = None) -> None:
        """What users did to a dataset: all its events so far, in order."""
        cancelled = bool(events) and events[-1].what == "cancelled"
        number = max((event.number for event in events), default=0)
        values = {"cancelled": cancelled, "events": number, "planned": False}
        with self.database.writing(within) as connection:
            connection.execute(update(datasets).where(datasets.c.name == name).values(**values))

    def add_snapshot(self, snapshot: Snapshot, *, within: Connection | None = None) -> None:
        """A snapshot, without its list of shards."""
        row = {
            "dataset": snapshot.dataset,
            "digest": snapshot.digest,
            "created": snapshot.created,
            "complete": snapshot.complete,
            "shards": len(snapshot.shards),
            "grasps": snapshot.grasps,
            "valid": snapshot.valid,
            "size_bytes": snapshot.size_bytes,
        }
        with self.database.writing(within) as connection:
            upsert(connection, dataset_snapshots, [row])

    def add_object_set(self, found: ObjectSet, *, within: Connection | None = None) -> None:
        """A version of a named set of objects."""
        row = {"name": found.name, "digest": found.digest, "objects": list(found.objects), "created": found.created}
        row |= {"project": found.project}
        with self.database.writing(within) as connection:
            upsert(connection, object_sets, [row])

    def set_progress(self, name: str, *, applied: int | None = None, planned: bool | None = None) -> None:
        """How far the planner is with a dataset."""
        values = {k: v for k, v in {"applied": applied, "planned": planned}.items() if v is not None}
        with self.database.writing() as connection:
            connection.execute(update(datasets).where(datasets.c.name == name).values(**values))
