"""Queries of workers, the whole service, usage and costs; the cost of a Prometheus scrape is constant."""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from sqlalchemy import ColumnElement, Connection, Select, Table, case, func, literal, select

from graspd.service.index.database import (
    Database,
    IndexPart,
    asset_scope_conditions,
    page_size,
    scope_conditions,
    scope_conditions_by_job,
    shard_scope_conditions,
)
from graspd.service.index.tables import assets, attempts, damage, datasets, jobs, shards, spent, tags, tasks, workers
from graspd.service.index.views import FailureGroup, MatrixCell, Stats, UsageDay, WorkerView
from graspd.service.model.clock import age_of, timestamp
from graspd.service.model.domain import JobRequest
from graspd.service.model.names import SHARD_KINDS
from graspd.service.model.projects import EVERYTHING, ProjectScope
from graspd.service.model.states import Stage, State


class Overview(IndexPart):
    def workers(self) -> list[WorkerView]:
        query = select(workers).order_by(case((workers.c.state == "lost", 1), else_=0), workers.c.name)
        return [WorkerView(**row) for row in self.database.rows(query)]

    def names(self, text: str, *, limit: int, scope: ProjectScope = EVERYTHING) -> list[tuple[str, str]]:
        """Return kind and name of datasets, assets and tags whose names contain a text."""
        sources = (
            (literal("dataset"), datasets.c.name, scope_conditions(scope, datasets)),
            (assets.c.kind, assets.c.name, asset_scope_conditions(scope)),
            (literal("tag"), tags.c.name, scope_conditions(scope, tags)),
        )
        found = []
        for kind, name, in_scope in sources:
            query = select(kind.label("kind"), name).distinct().where(name.icontains(text, autoescape=True), *in_scope)
            found += [(row["kind"], row["name"]) for row in self.database.rows(query.order_by(name).limit(limit))]
        return found

    def stats(self, *, scope: ProjectScope = EVERYTHING) -> Stats:
        alive = select(func.count()).select_from(workers).where(workers.c.state != "lost")
        sums = (func.count(), *_MADE, func.sum(shards.c.size_bytes))
        by_kind = select(shards.c.kind, *sums).group_by(shards.c.kind)
        by_kind = by_kind.where(*shard_scope_conditions(scope, shards.c.id))
        with self.database.read_transaction() as connection:
            of_jobs = _counts_by_state(connection, jobs, *scope_conditions(scope, jobs))
            of_tasks = _counts_by_state(connection, tasks, *scope_conditions_by_job(scope, tasks))
            of_shards = {kind: tuple(map(int, row)) for kind, *row in connection.execute(by_kind)}
            living = connection.scalar(alive)
        _, made, valid, candidates, validated, _ = of_shards.get("base", (0,) * 6)
        return Stats(
            jobs=of_jobs,
            tasks=of_tasks,
            grasps=made,
            valid=valid,
            candidates=candidates,
            validated=validated,
            shards=sum(row[0] for row in of_shards.values()),
            bytes=sum(row[5] for row in of_shards.values()),
            workers=int(living or 0),
        )

    def valid_per_minute(self, *, since: str, scope: ProjectScope = EVERYTHING) -> dict[str, int]:
        """Return the number of valid grasps per minute (2026-11-22T08:30) since a time, without empty minutes."""
        minute = func.substr(shards.c.created, 1, 16)
        recent = (shards.c.kind == "base", shards.c.created >= since)
        query = select(minute, func.sum(shards.c.valid)).group_by(minute)
        query = query.where(*recent, *shard_scope_conditions(scope, shards.c.id))
        with self.database.read_transaction() as connection:
            return {start: int(valid) for start, valid in connection.execute(query)}

    def failures(self, *, limit: int = 20, scope: ProjectScope = EVERYTHING) -> list[FailureGroup]:
        """Return failed attempts grouped by stage and error, the most frequent first."""
        number, newest = func.count().label("attempts"), func.max(attempts.c.ended).label("last_seen")
        in_scope, group = scope_conditions_by_job(scope, attempts), (attempts.c.stage, attempts.c.kind)
        query = select(*group, number, func.count(attempts.c.task_id.distinct()).label("tasks"), newest)
        query = query.where(*in_scope).group_by(*group).order_by(number.desc(), newest.desc()).limit(page_size(limit))
        groups = []
        with self.database.read_transaction() as connection:
            for row in connection.execute(query).mappings().all():
                same = (attempts.c.stage == row["stage"], attempts.c.kind == row["kind"])
                example = select(attempts.c.reason.label("example"), attempts.c.task_id)
                example = example.where(*same, attempts.c.ended == row["last_seen"], *in_scope).limit(1)
                groups.append(FailureGroup(**row, **connection.execute(example).mappings().one()))
        return groups

    def matrix(self, *, scope: ProjectScope = EVERYTHING) -> list[MatrixCell]:
        of_tasks = select(tasks.c.job_id, tasks.c.state, func.count()).group_by(tasks.c.job_id, tasks.c.state)
        made = select(shards.c.hand, shards.c.object, *_MADE).group_by(shards.c.hand, shards.c.object)
        made = made.where(shards.c.kind == "base", *shard_scope_conditions(scope, shards.c.id))
        cells: dict[tuple[str, str], dict[str, int]] = {}
        with self.database.read_transaction() as connection:
            pairs = {}
            of_jobs = select(jobs.c.id, jobs.c.hand, jobs.c.object).where(*scope_conditions(scope, jobs))
            for job, hand, obj in connection.execute(of_jobs):
                pairs[job] = cells.setdefault((hand, obj), dict.fromkeys(_CELL, 0))
                pairs[job]["jobs"] += 1
            for job, state, number in connection.execute(of_tasks):
                if state in _CELL and job in pairs:
                    pairs[job][state] += int(number)
            for hand, obj, *sums in connection.execute(made):
                if (hand, obj) in cells:
                    cells[hand, obj] |= zip(("grasps", "valid", "candidates", "validated"), map(int, sums), strict=True)
        return [MatrixCell(hand=hand, object=obj, **cells[hand, obj]) for hand, obj in sorted(cells)]


_CELL: Final = ("jobs", "queued", "running", "failed", "grasps", "valid", "candidates", "validated")
_MADE = tuple(func.sum(shards.c[name]) for name in ("count", "valid", "candidates", "validated"))


def _counts_by_state(connection: Connection, table: Table, *tests: ColumnElement[bool]) -> dict[State, int]:
    query = select(table.c.state, func.count()).where(*tests).group_by(table.c.state)
    found = {State(state): int(count) for state, count in connection.execute(query)}
    return {state: found.get(state, 0) for state in State}


MOST_JOBS: Final = 10_000
RATE_WINDOW_S: Final = 60
UNFINISHED: Final = (State.QUEUED, State.RUNNING)


@dataclass(frozen=True)
class IndexStatus:
    """Unfinished jobs, age [s] of the oldest, grasps per second in the last minute, and damage."""

    jobs: Mapping[State, int]
    oldest_s: Mapping[State, float]
    grasps_per_s: float
    valid_per_s: float
    damaged: int
    """Number of stored objects with known damage, at most `MOST_JOBS`."""


def read_index_status(database: Database) -> IndexStatus:
    """Return the status of an index for the metrics."""
    counted, oldest = {}, {}
    with database.read_transaction() as connection:
        for state in UNFINISHED:
            counted[state] = int(connection.scalar(job_count_query(state)) or 0)
            first = connection.scalar(oldest_job_query(state))
            oldest[state] = (first and age_of(first)) or 0.0
        some = select(damage.c.key).limit(MOST_JOBS).subquery()
        damaged = int(connection.scalar(select(func.count()).select_from(some)) or 0)
        made, valid = connection.execute(grasp_count_query(timestamp(RATE_WINDOW_S))).one()
    return IndexStatus(counted, oldest, int(made or 0) / RATE_WINDOW_S, int(valid or 0) / RATE_WINDOW_S, damaged)


def job_count_query(state: State) -> Select[Any]:
    some = select(jobs.c.id).where(jobs.c.state == state.value).limit(MOST_JOBS).subquery()
    return select(func.count()).select_from(some)


def oldest_job_query(state: State) -> Select[Any]:
    return select(jobs.c.created).where(jobs.c.state == state.value).order_by(jobs.c.created).limit(1)


def grasp_count_query(since: str) -> Select[Any]:
    base = (shards.c.kind == "base", shards.c.created >= since)
    return select(func.sum(shards.c.count), func.sum(shards.c.valid)).where(*base)


class Usage(IndexPart):
    def days(self, since: str, until: str, *, scope: ProjectScope = EVERYTHING) -> list[UsageDay]:
        """Return the usage of each project by day (2026-11-22), without empty days, newest first."""
        day = func.substr(shards.c.created, 1, 10).label("day")
        base = (_sum_over_base(column) for column in (shards.c.count, shards.c.valid))
        made = select(shards.c.charged, day, shards.c.device, *base, func.count(), func.sum(shards.c.seconds))
        made = made.where(shards.c.created >= since, shards.c.created < f"{until}T99")
        gone = select(spent).where(spent.c.day >= since, spent.c.day <= until, *scope_conditions(scope, spent))
        if not scope.everything:
            made = made.where(shards.c.charged == scope.project)
        days: dict[tuple[str, str], dict[str, Any]] = defaultdict(lambda: dict.fromkeys(_USED, 0))
        with self.database.read_transaction() as connection:
            live = connection.execute(made.group_by(shards.c.charged, day, shards.c.device)).all()
            for project, when, device, grasps, valid, tasks, seconds in [*live, *connection.execute(gone).all()]:
                found = days[when, project]
                found["grasps"] += int(grasps)
                found["valid"] += int(valid)
                found["tasks"] += int(tasks)
                found["gpu_seconds" if device.startswith("cuda") else "cpu_seconds"] += float(seconds)
        views = []
        for when, project in sorted(days, key=lambda key: (-int(key[0].replace("-", "")), key[1])):
            found = days[when, project]
            seconds = {name: round(float(found[name]), 3) for name in ("gpu_seconds", "cpu_seconds")}
            views.append(UsageDay(project=project, day=when, **{**found, **seconds}))
        return views

    def gpu_seconds(self, project: str, day: str) -> float:
        """Return the time [s] of GPU workers for the requests of a project on a day (2026-11-22)."""
        return sum(one.gpu_seconds for one in self.days(day, day, scope=ProjectScope(project, everything=False)))


def _sum_over_base(column: ColumnElement[Any]) -> ColumnElement[Any]:
    return func.sum(case((shards.c.kind == "base", column), else_=0))


_USED: Final = ("grasps", "valid", "tasks", "gpu_seconds", "cpu_seconds")


#: Maximum number of tasks per stage whose costs are read, newest first.
_NEWEST: Final = 2000


@dataclass(frozen=True)
class BatchCost:
    """Finished batches of a task: request, worker time [s], result and size."""

    hand: str
    object: str
    device: str
    request: JobRequest
    seconds: float
    count: int
    valid: int
    candidates: int
    size_bytes: int
    batches: int = 1

    @property
    def counted_grasps(self) -> int:
        """Grasps that count towards the request: valid ones, or all stored ones if validation is off."""
        return self.valid if self.request.counted_status == "valid" else self.count


class Costs(IndexPart):
    def batch_costs(
        self, stage: Stage, *, limit: int = _NEWEST, before: str = "", scope: ProjectScope = EVERYTHING
    ) -> list[BatchCost]:
        """Return the newest finished tasks of a stage, if given of those made before a time."""
        columns = [shards.c[name] for name in BatchCost.__dataclass_fields__ if name != "request"]
        query = select(*columns, shards.c.manifest["request"].label("request"))
        query = query.where(shards.c.kind == SHARD_KINDS[stage], *shard_scope_conditions(scope, shards.c.id))
        query = query.where(shards.c.created < before) if before else query
        rows = self.database.rows(query.order_by(shards.c.created.desc(), shards.c.id.desc()).limit(limit))
        return [BatchCost(**{**row, "request": JobRequest.model_validate(row["request"])}) for row in rows]
