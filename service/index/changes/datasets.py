"""Changes of the index on datasets, and what their planner asks it. Each change is idempotent."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from sqlalchemy import Connection, exists, or_, select, update

from service.index.database import Database, upsert
from service.index.dataset_tables import dataset_cells, dataset_snapshots, datasets, object_sets
from service.index.tables import jobs
from service.model.dataset_records import Cell, DatasetEvent, DatasetRecord, Member, ObjectSet, Snapshot
from service.model.domain import JobOptions, State


@dataclass(frozen=True)
class DatasetWork:
    """A dataset on which the planner has something left to do."""

    name: str
    options: JobOptions
    revisions: dict[str, int]
    cancelled: bool
    events: int
    applied: int
    owner: str


class DatasetChanges(Database):
    """Writes on datasets. `within` makes a write part of a larger transaction."""

    def add_dataset(self, record: DatasetRecord, *, within: Connection | None = None) -> None:
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
            "cancelled": False,
            "events": 0,
            "applied": 0,
            "planned": False,
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
            }
            for cell in record.cells()
        ]
        with self.writing(within) as connection:
            upsert(connection, datasets, [row], keep=("cancelled", "events", "applied", "planned"))
            upsert(connection, dataset_cells, cells)

    def set_dataset_events(
        self, name: str, events: Sequence[DatasetEvent], *, within: Connection | None = None
    ) -> None:
        """What users did to a dataset: all its events so far, in order."""
        cancelled = bool(events) and events[-1].what == "cancelled"
        number = max((event.number for event in events), default=0)
        values = {"cancelled": cancelled, "events": number, "planned": False}
        with self.writing(within) as connection:
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
        with self.writing(within) as connection:
            upsert(connection, dataset_snapshots, [row])

    def add_object_set(self, found: ObjectSet, *, within: Connection | None = None) -> None:
        """A version of a named set of objects."""
        row = {"name": found.name, "digest": found.digest, "objects": list(found.objects), "created": found.created}
        with self.writing(within) as connection:
            upsert(connection, object_sets, [row])

    def datasets_in_work(self) -> list[DatasetWork]:
        """Datasets with cells to plan or with events to pass on to their jobs, the oldest first."""
        query = (
            select(datasets)
            .where(or_(datasets.c.planned.is_(False), datasets.c.applied < datasets.c.events))
            .order_by(datasets.c.created, datasets.c.name)
        )
        with self.reading() as connection:
            return [
                DatasetWork(
                    row["name"],
                    JobOptions.model_validate(row["options"]),
                    row["revisions"],
                    row["cancelled"],
                    row["events"],
                    row["applied"],
                    row["owner"],
                )
                for row in connection.execute(query).mappings()
            ]

    def cells_to_plan(self, name: str, *, after: int, limit: int) -> list[Cell]:
        """The next cells whose job does not exist yet, behind a position."""
        query = (
            select(dataset_cells)
            .outerjoin(jobs, jobs.c.id == dataset_cells.c.job_id)
            .where(dataset_cells.c.dataset == name, dataset_cells.c.position > after, jobs.c.id.is_(None))
            .order_by(dataset_cells.c.position)
            .limit(limit)
        )
        with self.reading() as connection:
            return [
                Cell(
                    row["position"],
                    Member(name=row["hand"], digest=row["hand_digest"]),
                    Member(name=row["object"], digest=row["object_digest"]),
                    row["job_id"],
                    row["fidelity"] or "",
                )
                for row in connection.execute(query).mappings()
            ]

    def cells_in_states(
        self, name: str, states: Collection[State], *, after: int, limit: int, unshared: bool
    ) -> list[tuple[int, str]]:
        """Positions and jobs of the next cells in some states, behind a position.

        Args:
            unshared: leave out jobs that another dataset, which is not cancelled, waits for as well, and those that
                another key submitted.
        """
        query = (
            select(dataset_cells.c.position, dataset_cells.c.job_id)
            .join(jobs, jobs.c.id == dataset_cells.c.job_id)
            .where(dataset_cells.c.dataset == name, dataset_cells.c.position > after)
            .where(jobs.c.state.in_([state.value for state in states]))
            .order_by(dataset_cells.c.position)
            .limit(limit)
        )
        if unshared:
            other = dataset_cells.alias()
            query = query.join(datasets, datasets.c.name == dataset_cells.c.dataset)
            query = query.where(jobs.c.owner == datasets.c.owner)
            others = datasets.alias()
            waits = (other.c.job_id == dataset_cells.c.job_id, other.c.dataset != name)
            query = query.where(
                ~exists().where(*waits, others.c.name == other.c.dataset, others.c.cancelled.is_(False))
            )
        with self.reading() as connection:
            return [(position, job) for position, job in connection.execute(query)]

    def set_dataset_progress(self, name: str, *, applied: int | None = None, planned: bool | None = None) -> None:
        """How far the planner is with a dataset."""
        values = {k: v for k, v in {"applied": applied, "planned": planned}.items() if v is not None}
        with self.writing() as connection:
            connection.execute(update(datasets).where(datasets.c.name == name).values(**values))
