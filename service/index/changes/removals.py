"""Rows that go: what uses a thing, and what is removed with it. Each removal is idempotent."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy import Connection, delete, exists, func, insert, or_, select, update

from graspd.service.index.database import Database
from graspd.service.index.tables import (
    assets,
    attempts,
    dataset_cells,
    dataset_snapshots,
    datasets,
    grasps,
    jobs,
    object_sets,
    shards,
    spent,
    tasks,
)
from graspd.service.index.views import AssetView
from graspd.service.model.errors import NotFoundError
from graspd.service.model.states import AssetKind, Priority, State


@dataclass(frozen=True)
class Removals:
    """`within` makes a read or a write part of a larger transaction: what was looked at must still hold."""

    database: Database

    def user_of_asset(self, asset: AssetView, *, within: Connection) -> str:
        """What needs a hand, object or network, in a few words; empty if nothing does."""
        kind, digest = asset.kind, asset.digest
        column = f"{kind.value}_digest"
        if job := within.scalar(select(jobs.c.id).where(jobs.c[column] == digest).limit(1)):
            return f"job {job}"
        # The cells of a dataset share its network.
        name = datasets.c.name if kind is AssetKind.NETWORK else dataset_cells.c.dataset
        if dataset := within.scalar(select(name).where(name.table.c[column] == digest).limit(1)):
            return f"dataset {dataset!r}"
        if kind is AssetKind.OBJECT:
            if user := _user_of_neighbour(digest, within):
                return user
            newest = select(object_sets).order_by(object_sets.c.name, object_sets.c.created, object_sets.c.digest)
            rows = {row["name"]: row for row in within.execute(newest).mappings()}
            # By the same name another project's set means another object, unless this one is shared.
            near = [row for row in rows.values() if asset.shared or row["project"] == asset.project]
            if found := next((row["name"] for row in near if asset.name in row["objects"]), None):
                return f"the set of objects {found!r}"
        return ""

    def user_of_job(self, job_id: str, *, within: Connection) -> str:
        """Why a job must stay, in a few words that follow its name; empty if it may go."""
        state = within.scalar(select(jobs.c.state).where(jobs.c.id == job_id))
        if state is None:
            raise NotFoundError(f"there is no job {job_id!r}")
        if not State(state).is_final:
            return f"is {state}; cancel it first"
        dataset = within.scalar(select(dataset_cells.c.dataset).where(dataset_cells.c.job_id == job_id).limit(1))
        return f"belongs to dataset {dataset!r}; delete that first" if dataset else ""

    def attempts_of(self, job_id: str, *, within: Connection) -> tuple[tuple[str, int], ...]:
        """Task and number of each failed attempt of a job."""
        query = select(attempts.c.task_id, attempts.c.number).where(attempts.c.job_id == job_id)
        return tuple((task, number) for task, number in within.execute(query))

    def snapshots_of(self, dataset: str, *, within: Connection) -> int:
        """How many snapshots a dataset has."""
        query = select(func.count()).where(dataset_snapshots.c.dataset == dataset)
        return int(within.scalar(query) or 0)

    def planned_only(self, ids: Sequence[str]) -> list[str]:
        """Of these jobs, those that only a dataset's planner made, nobody by themselves, and that no dataset holds."""
        query = select(jobs.c.id).where(
            jobs.c.id.in_(ids), jobs.c.priority == Priority.BULK.value, jobs.c.origin.is_(None)
        )
        query = query.where(~exists().where(dataset_cells.c.job_id == jobs.c.id))
        with self.database.reading() as connection:
            return list(connection.scalars(query))

    def unneeded_shards(self, ids: Sequence[str]) -> set[str]:
        """Of these shards, those that are there and that no task of any job makes or reads."""
        query = select(shards.c.id).where(shards.c.id.in_(ids), ~exists().where(tasks.c.shard_id == shards.c.id))
        with self.database.reading() as connection:
            return set(connection.scalars(query))

    def remove_asset(self, kind: AssetKind, digest: str, *, within: Connection | None = None) -> None:
        """A hand, object or network."""
        with self.database.writing(within) as connection:
            connection.execute(delete(assets).where(assets.c.kind == kind.value, assets.c.digest == digest))

    def remove_job(self, job_id: str, *, within: Connection | None = None) -> None:
        """A job, its tasks and their attempts."""
        with self.database.writing(within) as connection:
            of_job = select(tasks.c.id).where(tasks.c.job_id == job_id)
            gone = or_(attempts.c.job_id == job_id, attempts.c.task_id.in_(of_job))
            connection.execute(delete(attempts).where(gone))
            connection.execute(delete(tasks).where(tasks.c.job_id == job_id))
            connection.execute(delete(jobs).where(jobs.c.id == job_id))

    def remove_dataset(self, name: str, *, within: Connection | None = None) -> None:
        """A dataset with its cells and snapshots."""
        with self.database.writing(within) as connection:
            connection.execute(delete(dataset_snapshots).where(dataset_snapshots.c.dataset == name))
            connection.execute(delete(dataset_cells).where(dataset_cells.c.dataset == name))
            connection.execute(delete(datasets).where(datasets.c.name == name))

    def remove_shard(self, shard: str, *, within: Connection) -> bool:
        """A shard with its grasps, unless a task needs it; whether it may go."""
        if within.scalar(select(tasks.c.id).where(tasks.c.shard_id == shard).limit(1)) is not None:
            return False
        _remember_cost(shard, within)
        within.execute(delete(grasps).where(grasps.c.shard_id == shard))
        within.execute(delete(shards).where(shards.c.id == shard))
        return True


def _remember_cost(shard: str, connection: Connection) -> None:
    """Add what a shard that goes had cost to what its project spent on that day."""
    row = connection.execute(select(shards).where(shards.c.id == shard)).mappings().first()
    if row is None:
        return
    key = {"project": row["charged"], "day": row["created"][:10], "device": row["device"]}
    is_base = row["kind"] == "base"
    more = {"grasps": row["count"] if is_base else 0, "valid": row["valid"] if is_base else 0}
    more |= {"tasks": 1, "seconds": row["seconds"]}
    same = [spent.c[name] == value for name, value in key.items()]
    sums = {name: spent.c[name] + value for name, value in more.items()}
    if not connection.execute(update(spent).where(*same).values(**sums)).rowcount:
        connection.execute(insert(spent).values(**key, **more))


def _user_of_neighbour(digest: str, connection: Connection) -> str:
    """What has an object in its scenes beside its own, in a few words; empty if nothing does."""
    among = f"%{digest}%"
    # The first test leaves an index those that have any.
    of_job = select(jobs.c.id).where(jobs.c.neighbours > "", jobs.c.neighbours.like(among)).limit(1)
    if job := connection.scalar(of_job):
        return f"job {job}"
    dataset = connection.scalar(select(datasets.c.name).where(datasets.c.neighbours.like(among)).limit(1))
    return f"dataset {dataset!r}" if dataset else ""
