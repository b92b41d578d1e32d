"""What the planner of datasets asks the index: what is left to do, cell by cell."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from sqlalchemy import exists, or_, select

from service.index.database import Database
from service.index.tables import dataset_cells, datasets, jobs
from service.model.dataset_records import Cell, Member
from service.model.domain import JobOptions
from service.model.records import Choice
from service.model.states import State


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
    project: str


@dataclass(frozen=True)
class DatasetFeed:
    """Reads of the planner."""

    database: Database

    def in_work(self) -> list[DatasetWork]:
        """Datasets with cells to plan or with events to pass on to their jobs, the oldest first."""
        query = (
            select(datasets)
            .where(or_(datasets.c.planned.is_(False), datasets.c.applied < datasets.c.events))
            .order_by(datasets.c.created, datasets.c.name)
        )
        with self.database.reading() as connection:
            return [
                DatasetWork(
                    row["name"],
                    JobOptions.model_validate(row["options"]),
                    row["revisions"],
                    row["cancelled"],
                    row["events"],
                    row["applied"],
                    row["owner"],
                    row["project"],
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
        with self.database.reading() as connection:
            return [
                Cell(
                    row["position"],
                    Member(name=row["hand"], digest=row["hand_digest"]),
                    Member(name=row["object"], digest=row["object_digest"]),
                    row["job_id"],
                    row["fidelity"] or "",
                    row["choice"] and Choice.model_validate(row["choice"]),
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
        with self.database.reading() as connection:
            return [(position, job) for position, job in connection.execute(query)]
