"""Removal of rows that nothing else needs. All removals are idempotent."""

from collections.abc import Sequence

from sqlalchemy import Connection, delete, exists, func, insert, or_, select, update

from graspd.service.index.database import IndexPart
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


class Removals(IndexPart):
    """`within` makes a read or write part of a larger transaction, so that checks still hold at the write."""

    def reason_to_keep_asset(self, asset: AssetView, *, within: Connection) -> str:
        """Describe a job, dataset or set that needs a hand, object or network; empty if there is none."""
        kind, digest = asset.kind, asset.digest
        column = f"{kind.value}_digest"
        if job := within.scalar(select(jobs.c.id).where(jobs.c[column] == digest).limit(1)):
            return f"job {job}"
        # The cells of a dataset share its network.
        name = datasets.c.name if kind is AssetKind.NETWORK else dataset_cells.c.dataset
        if dataset := within.scalar(select(name).where(name.table.c[column] == digest).limit(1)):
            return f"dataset {dataset!r}"
        if kind is AssetKind.OBJECT:
            if user := _reason_to_keep_neighbour(digest, within):
                return user
            newest = select(object_sets).order_by(object_sets.c.name, object_sets.c.created, object_sets.c.digest)
            rows = {row["name"]: row for row in within.execute(newest).mappings()}
            for row in rows.values():
                # Sets of other projects can contain this object only if it is shared.
                if (asset.shared or row["project"] == asset.project) and asset.name in row["objects"]:
                    return f"the set of objects {row['name']!r}"
        return ""

    def reason_to_keep_job(self, job_id: str, *, within: Connection) -> str:
        """Return why a job cannot be deleted, as text to follow `job ID`; empty if it can."""
        state = within.scalar(select(jobs.c.state).where(jobs.c.id == job_id))
        if state is None:
            raise NotFoundError(f"there is no job {job_id!r}")
        if not State(state).is_final:
            return f"is {state}; cancel it first"
        dataset = within.scalar(select(dataset_cells.c.dataset).where(dataset_cells.c.job_id == job_id).limit(1))
        return f"belongs to dataset {dataset!r}; delete that first" if dataset else ""

    def attempts_of(self, job_id: str, *, within: Connection) -> tuple[tuple[str, int], ...]:
        query = select(attempts.c.task_id, attempts.c.number).where(attempts.c.job_id == job_id)
        return tuple((row.task_id, row.number) for row in within.execute(query))

    def count_snapshots(self, dataset: str, *, within: Connection) -> int:
        query = select(func.count()).where(dataset_snapshots.c.dataset == dataset)
        return int(within.scalar(query) or 0)

    def orphaned_dataset_jobs(self, ids: Sequence[str]) -> list[str]:
        """Return those of the given jobs that were planned for a dataset and are in no dataset now."""
        planned = (jobs.c.priority == Priority.BULK.value, jobs.c.origin.is_(None))
        needed = exists().where(dataset_cells.c.job_id == jobs.c.id)
        return self.database.column(select(jobs.c.id).where(jobs.c.id.in_(ids), *planned, ~needed))

    def unneeded_shards(self, ids: Sequence[str]) -> set[str]:
        """Return those of the given shards that exist and that no task produces."""
        query = select(shards.c.id).where(shards.c.id.in_(ids), ~exists().where(tasks.c.shard_id == shards.c.id))
        return set(self.database.column(query))

    def remove_asset(self, kind: AssetKind, digest: str, *, within: Connection | None = None) -> None:
        with self.database.write_transaction(within) as connection:
            connection.execute(delete(assets).where(assets.c.kind == kind.value, assets.c.digest == digest))

    def remove_job(self, job_id: str, *, within: Connection | None = None) -> None:
        with self.database.write_transaction(within) as connection:
            of_job = select(tasks.c.id).where(tasks.c.job_id == job_id)
            gone = or_(attempts.c.job_id == job_id, attempts.c.task_id.in_(of_job))
            connection.execute(delete(attempts).where(gone))
            connection.execute(delete(tasks).where(tasks.c.job_id == job_id))
            connection.execute(delete(jobs).where(jobs.c.id == job_id))

    def remove_dataset(self, name: str, *, within: Connection | None = None) -> None:
        with self.database.write_transaction(within) as connection:
            connection.execute(delete(dataset_snapshots).where(dataset_snapshots.c.dataset == name))
            connection.execute(delete(dataset_cells).where(dataset_cells.c.dataset == name))
            connection.execute(delete(datasets).where(datasets.c.name == name))

    def remove_shard(self, shard: str, *, within: Connection) -> bool:
        """Remove a shard with its grasps unless a task produces it; return whether its files can be deleted."""
        if within.scalar(select(tasks.c.id).where(tasks.c.shard_id == shard).limit(1)) is not None:
            return False
        _record_cost(shard, within)
        within.execute(delete(grasps).where(grasps.c.shard_id == shard))
        within.execute(delete(shards).where(shards.c.id == shard))
        return True


def _record_cost(shard: str, connection: Connection) -> None:
    """Add the cost of a shard to table `spent`; deleted results count as usage."""
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


def _reason_to_keep_neighbour(digest: str, connection: Connection) -> str:
    """Describe a job or dataset that has the object as a neighbour; empty if there is none."""
    among = f"%{digest}%"
    # The first condition uses the index `jobs_beside`, so only jobs with neighbours are read.
    of_job = select(jobs.c.id).where(jobs.c.neighbours > "", jobs.c.neighbours.like(among)).limit(1)
    if job := connection.scalar(of_job):
        return f"job {job}"
    dataset = connection.scalar(select(datasets.c.name).where(datasets.c.neighbours.like(among)).limit(1))
    return f"dataset {dataset!r}" if dataset else ""
