"""Queries of the controller: tasks to queue, tasks marked as queued, cells of datasets without a job."""

from collections import defaultdict
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Column, ColumnElement, exists, or_, select

from graspd.service.index.database import IndexPart
from graspd.service.index.tables import assets, dataset_cells, datasets, jobs, tasks
from graspd.service.model.domain import JobOptions
from graspd.service.model.planning import MAX_BACKOFF_S, PlannedTask, RoundRobin, WaitingJob, interleave, queue_owner
from graspd.service.model.records import Cell, DatasetMember, FidelityChoice, JobRecord
from graspd.service.model.states import AssetKind, Priority, Stage, State


@dataclass(frozen=True)
class ReadyTask:
    """Task to queue, with the content of its message."""

    job: JobRecord
    task: PlannedTask
    priority: Priority
    last_attempt: int
    retried_upto: int


@dataclass(frozen=True)
class ReadyCheck:
    """Uploaded hand or object with a pending check."""

    kind: AssetKind
    name: str
    digest: str
    last_attempt: int


class Feed(IndexPart):
    def waiting_jobs(self, priority: Priority, *, now: float) -> list[WaitingJob]:
        """Return the jobs with a task to queue at `now` [Unix time, s], the oldest first."""
        unfinished = jobs.c.state.in_((State.QUEUED.value, State.RUNNING.value))
        waiting = exists().where(tasks.c.job_id == jobs.c.id, *_WAITING, _due_condition(tasks.c.not_before, now))
        query = select(jobs.c.id, jobs.c.origin, jobs.c.project).order_by(jobs.c.created, jobs.c.id)
        rows = self.database.rows(query.where(unfinished, jobs.c.priority == priority.value, waiting))
        keys = [(row["origin"] or {}).get("key", "") for row in rows]
        return [WaitingJob(row["id"], queue_owner(row["project"], key)) for row, key in zip(rows, keys, strict=True)]

    def ready_tasks(self, priority: Priority, turns: RoundRobin, *, now: float, limit: int) -> list[ReadyTask]:
        """Return at most `limit` tasks to queue, round-robin over projects or keys, then over their jobs."""
        of_key: dict[str, list[list[tuple[WaitingJob, ReadyTask]]]] = defaultdict(list)
        for job, share in turns.next_jobs(self.waiting_jobs(priority, now=now), limit):
            of_key[job.key].append([(job, task) for task in self.ready_tasks_of_job(job.id, limit=share, now=now)])
        chosen = interleave([interleave(of_jobs) for of_jobs in of_key.values()])[:limit]
        turns.record_served([job for job, _ in chosen])
        return [task for _, task in chosen]

    def ready_tasks_of_job(self, job_id: str, *, limit: int, now: float | None = None) -> list[ReadyTask]:
        """Return the first tasks of a job to queue; without `now`, back-offs are ignored."""
        due = () if now is None else (_due_condition(tasks.c.not_before, now),)
        query = select(tasks, *(jobs.c[name] for name in _OF_THE_JOB)).join(jobs, jobs.c.id == tasks.c.job_id)
        query = query.where(tasks.c.job_id == job_id, *_WAITING, *due).order_by(tasks.c.batch)
        rows = self.database.rows(query.limit(limit))
        record = _record(rows[0]) if rows else None
        return [_ready_task(row, record) for row in rows if record is not None]

    def ready_checks(self, *, now: float, limit: int) -> list[ReadyCheck]:
        open_ = (assets.c.verdict.is_(None), assets.c.queued.is_(False), _due_condition(assets.c.not_before, now))
        query = select(assets).where(*open_).order_by(assets.c.created).limit(limit)
        return [
            ReadyCheck(AssetKind(row["kind"]), row["name"], row["digest"], row["last_attempt"])
            for row in self.database.rows(query)
        ]

    def queued_tasks_and_checks(self) -> tuple[set[str], set[tuple[AssetKind, str]]]:
        """Return the unfinished tasks and asset checks that the index marks as queued."""
        unfinished = tasks.c.state.in_((State.QUEUED.value, State.RUNNING.value))
        of_tasks = select(tasks.c.id).where(tasks.c.ready.is_(True), tasks.c.queued.is_(True), unfinished)
        of_checks = select(assets.c.kind, assets.c.digest).where(assets.c.queued.is_(True), assets.c.verdict.is_(None))
        with self.database.read_transaction() as connection:
            checks = {(AssetKind(kind), digest) for kind, digest in connection.execute(of_checks)}
            return set(connection.scalars(of_tasks)), checks

    def outputs(self, task_ids: Collection[str]) -> dict[str, tuple[str, str]]:
        query = select(tasks.c.id, tasks.c.stage, tasks.c.shard_id)
        return {task: (stage, shard) for task, stage, shard in self.database.matching_rows(query, tasks.c.id, task_ids)}

    def cancelled_tasks(self, task_ids: Collection[str]) -> set[str]:
        query = select(tasks.c.id).where(tasks.c.state == State.CANCELLED.value)
        return {row.id for row in self.database.matching_rows(query, tasks.c.id, task_ids)}

    def failed_tasks(self, job_id: str) -> dict[str, int]:
        """Return failed and cancelled tasks of a job with the number of their last attempt."""
        final = tasks.c.state.in_((State.FAILED.value, State.CANCELLED.value))
        query = select(tasks.c.id, tasks.c.last_attempt).where(tasks.c.job_id == job_id, final)
        return {row["id"]: row["last_attempt"] for row in self.database.rows(query)}

    def queued_tasks(self, job_id: str) -> list[str]:
        """Return the tasks of a job that are marked as queued; running ones are, too."""
        return self.database.column(select(tasks.c.id).where(tasks.c.job_id == job_id, tasks.c.queued.is_(True)))


_OF_THE_JOB = ("request", "revisions", "span", "origin", "hand_digest", "object_digest")
_WAITING = (tasks.c.ready.is_(True), tasks.c.queued.is_(False))


def _due_condition(not_before: Column[float], now: float) -> ColumnElement[bool]:
    # A due time further away than any back-off means that the clock was set back: the task is due at once.
    return or_(not_before <= now, not_before > now + 2 * MAX_BACKOFF_S)


def _record(row: Any) -> JobRecord:
    return JobRecord(id=row["job_id"], **{name: row[name] for name in (*_OF_THE_JOB, "priority", "created")})


def _ready_task(row: Any, record: JobRecord) -> ReadyTask:
    stage, inputs = Stage(row["stage"]), tuple(row["inputs"])
    task = PlannedTask(row["id"], stage, row["batch"], row["count"], inputs, row["shard_id"])
    return ReadyTask(record, task, Priority(row["priority"]), row["last_attempt"], row["retried_upto"])


@dataclass(frozen=True)
class DatasetWork:
    name: str
    options: JobOptions
    revisions: dict[str, int]
    cancelled: bool
    events: int
    applied: int
    owner: str
    project: str


class DatasetFeed(IndexPart):
    def pending_datasets(self) -> list[DatasetWork]:
        """Return datasets with cells to plan or with events for their jobs, the oldest first."""
        pending = or_(datasets.c.planned.is_(False), datasets.c.applied < datasets.c.events)
        query = select(datasets).where(pending).order_by(datasets.c.created, datasets.c.name)
        plain = ("name", "revisions", "cancelled", "events", "applied", "owner", "project")
        return [
            DatasetWork(options=JobOptions.model_validate(row["options"]), **{name: row[name] for name in plain})
            for row in self.database.rows(query)
        ]

    def cells_to_plan(self, name: str, *, after: int, limit: int) -> list[Cell]:
        """Return the next cells without a job, after position `after`."""
        query = select(dataset_cells).outerjoin(jobs, jobs.c.id == dataset_cells.c.job_id)
        query = query.where(dataset_cells.c.dataset == name, dataset_cells.c.position > after, jobs.c.id.is_(None))
        query = query.order_by(dataset_cells.c.position).limit(limit)
        return [
            Cell(
                row["position"],
                DatasetMember(name=row["hand"], digest=row["hand_digest"]),
                DatasetMember(name=row["object"], digest=row["object_digest"]),
                row["job_id"],
                row["fidelity"] or "",
                row["choice"] and FidelityChoice.model_validate(row["choice"]),
            )
            for row in self.database.rows(query)
        ]

    def cells_in_states(
        self, name: str, states: Collection[State], *, after: int, limit: int, unshared: bool
    ) -> list[tuple[int, str]]:
        """Return positions and jobs of the next cells in these states, after position `after`.

        `unshared` omits jobs submitted by another key, and jobs that another dataset in progress needs.
        """
        in_states = jobs.c.state.in_([state.value for state in states])
        query = select(dataset_cells.c.position, dataset_cells.c.job_id)
        query = query.join(jobs, jobs.c.id == dataset_cells.c.job_id).order_by(dataset_cells.c.position).limit(limit)
        query = query.where(dataset_cells.c.dataset == name, dataset_cells.c.position > after, in_states)
        if unshared:
            query = query.join(datasets, datasets.c.name == dataset_cells.c.dataset)
            query = query.where(jobs.c.owner == datasets.c.owner)
            other, others = dataset_cells.alias(), datasets.alias()
            same_job = (other.c.job_id == dataset_cells.c.job_id, other.c.dataset != name)
            waits = (*same_job, others.c.name == other.c.dataset, others.c.cancelled.is_(False))
            query = query.where(~exists().where(*waits))
        return [(row["position"], row["job_id"]) for row in self.database.rows(query)]
