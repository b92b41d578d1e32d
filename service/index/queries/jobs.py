"""Queries of jobs, tasks, attempts and shards, and the outcomes of a job's candidates."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

from sqlalchemy import ColumnElement, Connection, Float, and_, case, cast, func, select, tuple_

from graspd.service.index import project_scope
from graspd.service.index.database import Database, chunks
from graspd.service.index.project_scope import seen_jobs, seen_shards, seen_tasks
from graspd.service.index.tables import attempts, jobs, shards, tasks
from graspd.service.index.views import AttemptView, JobView, Page, ShardView, StageProgress, TaskView
from graspd.service.model.errors import NotFoundError
from graspd.service.model.planning import ranges_of, totals
from graspd.service.model.projects import EVERYTHING, ProjectScope
from graspd.service.model.states import Stage, State


@dataclass(frozen=True)
class Jobs:
    """Reads of jobs and their parts."""

    database: Database

    def page(
        self,
        *,
        state: State | None = None,
        hand: str | None = None,
        object: str | None = None,
        limit: int = 50,
        cursor: str | None = None,
        scope: ProjectScope = EVERYTHING,
    ) -> Page[JobView]:
        """Return a page of jobs, newest first."""
        size = project_scope.page_size(limit)
        query = select(jobs).where(*seen_jobs(scope)).order_by(jobs.c.created.desc(), jobs.c.id.desc()).limit(size + 1)
        for column, wanted in ((jobs.c.state, state), (jobs.c.hand, hand), (jobs.c.object, object)):
            if wanted is not None:
                query = query.where(column == wanted)
        if cursor is not None:
            query = query.where(tuple_(jobs.c.created, jobs.c.id) < project_scope.decode(cursor, str, str))
        with self.database.reading() as connection:
            rows = connection.execute(query).mappings().all()
            views = _job_views(connection, rows[:size])
        last = project_scope.encode(views[-1].created, views[-1].id) if len(rows) > size else None
        return Page(items=views, next=last)

    def get(self, job_id: str, *, scope: ProjectScope = EVERYTHING) -> JobView:
        """Return a job with its progress; NotFoundError if there is none."""
        with self.database.reading() as connection:
            rows = connection.execute(select(jobs).where(jobs.c.id == job_id, *seen_jobs(scope))).mappings().all()
            if not rows:
                raise NotFoundError(f"there is no job {job_id!r}")
            (view,) = _job_views(connection, rows)
            if view.note is None:
                return view
            return view.model_copy(update={"outcomes": outcomes_of(connection, tasks.c.job_id == job_id)})

    def unfinished(self, ids: Collection[str]) -> set[str]:
        """Return those of the job ids whose job has not ended."""
        wanted, found = sorted(ids), set[str]()
        with self.database.reading() as connection:
            for start in range(0, len(wanted), 500):
                some = jobs.c.id.in_(wanted[start : start + 500])
                found |= set(connection.scalars(select(jobs.c.id).where(some, jobs.c.finished.is_(None))))
        return found

    def tasks(
        self,
        *,
        job: str | None = None,
        stage: Stage | None = None,
        state: State | None = None,
        limit: int = 50,
        cursor: str | None = None,
    ) -> Page[TaskView]:
        """Return a page of tasks by job, batch and stage."""
        size = project_scope.page_size(limit)
        key = (tasks.c.job_id, tasks.c.batch, tasks.c.position)
        query = select(tasks).order_by(*key).limit(size + 1)
        for column, wanted in ((tasks.c.job_id, job), (tasks.c.stage, stage), (tasks.c.state, state)):
            if wanted is not None:
                query = query.where(column == wanted)
        if cursor is not None:
            query = query.where(tuple_(*key) > project_scope.decode(cursor, str, int, int))
        with self.database.reading() as connection:
            rows = connection.execute(query).mappings().all()
        views = [_task_view(row) for row in rows[:size]]
        last = rows[size - 1] if len(rows) > size else None
        return Page(items=views, next=last and project_scope.encode(last["job_id"], last["batch"], last["position"]))

    def task(self, task_id: str, *, scope: ProjectScope = EVERYTHING) -> TaskView:
        """Return a task; NotFoundError if there is none."""
        with self.database.reading() as connection:
            row = connection.execute(select(tasks).where(tasks.c.id == task_id, *seen_tasks(scope))).mappings().first()
        if row is None:
            raise NotFoundError(f"there is no task {task_id!r}")
        return _task_view(row)

    def out_of_scope(self, task_ids: Collection[str], scope: ProjectScope) -> set[str]:
        """Return those of the tasks whose jobs are not in scope."""
        query = select(tasks.c.id).join(jobs, jobs.c.id == tasks.c.job_id).where(jobs.c.project != scope.project)
        with self.database.reading() as connection:
            return {
                task
                for some in chunks(list(task_ids))
                for task in connection.scalars(query.where(tasks.c.id.in_(some)))
            }

    def attempts(self, *, job: str | None = None, task: str | None = None, limit: int = 50) -> list[AttemptView]:
        """Return failed attempts of a job or a task, newest first."""
        query = select(attempts).order_by(attempts.c.ended.desc(), attempts.c.number.desc())
        if job is not None:
            query = query.where(attempts.c.job_id == job)
        if task is not None:
            query = query.where(attempts.c.task_id == task)
        with self.database.reading() as connection:
            rows = connection.execute(query.limit(project_scope.page_size(limit))).mappings().all()
        return [AttemptView(**{name: row[name] for name in AttemptView.model_fields}) for row in rows]


def _job_views(connection: Connection, rows: Sequence[Any]) -> list[JobView]:
    ids = [row["id"] for row in rows]
    progress = _progress(connection, ids)
    made = _made(connection, ids)
    views = [
        JobView(
            **{name: row[name] for name in JobView.model_fields if name in row},
            stages=progress[row["id"]],
            **made.get(row["id"], {}),
        )
        for row in rows
    ]
    wholes = (ranges_of(view.request.grasps, row["span"]) for view, row in zip(views, rows, strict=True))
    return [
        view.model_copy(update={"stages": [_whole(one, tasks) for one in view.stages]})
        for view, tasks in zip(views, wholes, strict=True)
    ]


def _whole(stage: StageProgress, tasks: int) -> StageProgress:
    """Add the tasks of a large job that are not yet entered."""
    more = max(0, tasks - stage.tasks)
    return stage.model_copy(update={"tasks": stage.tasks + more, "queued": stage.queued + more}) if more else stage


def _progress(connection: Connection, ids: Sequence[str]) -> dict[str, list[StageProgress]]:
    share: ColumnElement[float] = case(
        (tasks.c.state == State.SUCCEEDED.value, 1.0),
        (tasks.c.progress_total > 0, tasks.c.progress_done / tasks.c.progress_total),
        else_=0.0,
    )
    # A succeeded task ended when its shard was made; both times are texts of one format.
    reused = and_(tasks.c.done, tasks.c.finished < tasks.c.created)
    query = (
        select(
            tasks.c.job_id,
            tasks.c.position,
            tasks.c.stage,
            tasks.c.state,
            func.count().label("tasks"),
            func.sum(cast(share, Float)).label("done"),
            func.sum(case((reused, 0.0), else_=func.coalesce(tasks.c.seconds, 0.0))).label("seconds"),
            func.sum(case((reused, 1), else_=0)).label("reused"),
        )
        .where(tasks.c.job_id.in_(ids))
        .group_by(tasks.c.job_id, tasks.c.position, tasks.c.stage, tasks.c.state)
    )
    stages: dict[str, dict[int, dict[str, Any]]] = defaultdict(dict)
    for row in connection.execute(query).mappings():
        stage = stages[row["job_id"]].setdefault(
            row["position"], {"stage": row["stage"], "tasks": 0, "done": 0.0, "seconds": 0.0, "reused": 0}
        )
        stage[row["state"]] = row["tasks"]
        for name in ("tasks", "done", "seconds", "reused"):
            stage[name] += row[name]
    return {job: [StageProgress(**stages[job][position]) for position in sorted(stages[job])] for job in ids}


def _made(connection: Connection, ids: Sequence[str]) -> dict[str, dict[str, int]]:
    same = ("valid", "candidates", "validated", "rechecked", "recheck_held")
    columns = {"grasps": "count", **{name: name for name in same}}
    query = (
        select(tasks.c.job_id, *(func.sum(shards.c[column]).label(name) for name, column in columns.items()))
        .join(shards, shards.c.id == tasks.c.shard_id)
        .where(tasks.c.job_id.in_(ids), tasks.c.stage == Stage.SYNTHESIZE.value)
        .group_by(tasks.c.job_id)
    )
    rows = connection.execute(query).mappings()
    return {row["job_id"]: {name: int(row[name]) for name in columns} for row in rows}


def _task_view(row: Any) -> TaskView:
    return TaskView(
        id=row["id"],
        job_id=row["job_id"],
        stage=row["stage"],
        batch=row["batch"],
        count=row["count"],
        state=row["state"],
        shard_id=row["shard_id"],
        attempt=row["last_attempt"] + (not State(row["state"]).is_final or row["last_attempt"] == 0),
        worker=row["worker"],
        device=row["device"],
        done=row["progress_done"],
        total=row["progress_total"],
        message=row["progress_message"],
        reason=row["reason"],
        seconds=row["seconds"],
        finished=row["finished"],
    )


#: Most shards that are read: enough for the reasons, and the page stays fast.
MOST_SHARDS: Final = 1000


def outcomes_of(connection: Connection, of_jobs: ColumnElement[bool]) -> dict[str, int]:
    """Count rejected candidates by outcome, in the first `MOST_SHARDS` shards of the selected jobs."""
    query = (
        select(shards.c.manifest["info"]["outcomes"])
        .join(tasks, tasks.c.shard_id == shards.c.id)
        .where(of_jobs, tasks.c.stage == Stage.SYNTHESIZE.value)
        .limit(MOST_SHARDS)
    )
    return totals(one for one in connection.scalars(query) if isinstance(one, dict))


@dataclass(frozen=True)
class Shards:
    """Reads of shards."""

    database: Database

    def page(
        self,
        *,
        job: str | None = None,
        kind: Literal["base", "scene", "views"] | None = None,
        hand: str | None = None,
        object: str | None = None,
        limit: int = 50,
        cursor: str | None = None,
        scope: ProjectScope = EVERYTHING,
    ) -> Page[ShardView]:
        """Return a page of shards, newest first, without their manifests."""
        size = project_scope.page_size(limit)
        query = (
            select(shards)
            .where(*seen_shards(scope, shards.c.id))
            .order_by(shards.c.created.desc(), shards.c.id.desc())
            .limit(size + 1)
        )
        for column, wanted in ((shards.c.kind, kind), (shards.c.hand, hand), (shards.c.object, object)):
            if wanted is not None:
                query = query.where(column == wanted)
        if job is not None:
            query = query.where(shards.c.id.in_(select(tasks.c.shard_id).where(tasks.c.job_id == job)))
        if cursor is not None:
            query = query.where(tuple_(shards.c.created, shards.c.id) < project_scope.decode(cursor, str, str))
        with self.database.reading() as connection:
            rows = connection.execute(query).mappings().all()
        views = [_shard_view(row, whole=False) for row in rows[:size]]
        last = views[-1] if len(rows) > size else None
        return Page(items=views, next=last and project_scope.encode(last.created, last.id))

    def assets_of(self, ids: Collection[str]) -> dict[str, tuple[str, str]]:
        """Return the digests of hand and object of each of these shards."""
        query = select(shards.c.id, shards.c.hand_digest, shards.c.object_digest).where(shards.c.id.in_(ids))
        with self.database.reading() as connection:
            return {shard: (hand, obj) for shard, hand, obj in connection.execute(query)}

    def job_of(self, shard_id: str, *, scope: ProjectScope = EVERYTHING) -> str | None:
        """Return a job in scope that requested this shard; None if a pruned index has none."""
        with self.database.reading() as connection:
            query = select(tasks.c.job_id).where(tasks.c.shard_id == shard_id, *seen_tasks(scope)).limit(1)
            found: str | None = connection.scalar(query)
        return found

    def get(self, shard_id: str, *, scope: ProjectScope = EVERYTHING) -> ShardView:
        """Return a shard with its manifest; NotFoundError if there is none."""
        with self.database.reading() as connection:
            seen = seen_shards(scope, shards.c.id)
            row = connection.execute(select(shards).where(shards.c.id == shard_id, *seen)).mappings().first()
        if row is None:
            raise NotFoundError(f"there is no shard {shard_id!r}")
        return _shard_view(row, whole=True)


def _shard_view(row: Any, *, whole: bool) -> ShardView:
    values = {name: row[name] for name in ShardView.model_fields if name != "manifest"}
    return ShardView(**values, manifest=row["manifest"] if whole else {})
