"""Queries of jobs, tasks, attempts and shards, and the outcomes of a job's candidates."""

from collections import Counter, defaultdict
from collections.abc import Collection, Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import Any, Final, Literal, Unpack

from sqlalchemy import Column, ColumnElement, Connection, Float, and_, case, cast, func, literal_column, select

from graspd.service.index import database
from graspd.service.index.tables import attempts, dataset_cells, jobs, shards, tasks
from graspd.service.index.views import AttemptView, JobView, Page, ShardView, StageProgress, TaskView
from graspd.service.model.planning import count_ranges, phase_seconds, sum_outcomes
from graspd.service.model.projects import EVERYTHING, ProjectScope
from graspd.service.model.states import Stage, State
from graspd.service.store.columns import ShardKind

#: Finished share of a task.
SHARE_DONE: Final[ColumnElement[float]] = case(
    (tasks.c.state == State.SUCCEEDED.value, 1.0),
    (tasks.c.progress_total > 0, tasks.c.progress_done / tasks.c.progress_total),
    else_=0.0,
)


#: The shard of a task is reused if it is older than the task; both times are texts of one format.
_REUSED: Final = tasks.c.done & (tasks.c.finished < tasks.c.created)
#: Order by the time from the submission of a job to its end; unfinished jobs count as ending last.
_DURATION: Final = {
    "sqlite": "julianday(coalesce(jobs.finished, '9999-01-01')) - julianday(jobs.created)",
    "postgresql": "extract(epoch from coalesce(jobs.finished, '9999-01-01')::timestamptz - jobs.created::timestamptz)",
}
JobSort = Literal["created", "hand", "object", "state", "duration"]


class Jobs(database.IndexPart):
    def page(
        self,
        *,
        state: State | None = None,
        hand: str | None = None,
        object: str | None = None,
        prefix: str = "",
        words: Mapping[str, Collection[str]] = MappingProxyType({}),
        sort: JobSort = "created",
        descending: bool = True,
        scope: ProjectScope = EVERYTHING,
        **part: Unpack[database.Paging],
    ) -> Page[JobView]:
        """Return a page of jobs, by default the newest first; `prefix` is the beginning of their ids.

        Each of `words` occurs in hand, object or the name of a dataset, begins the id, or has ids of the owner.
        """
        same = _equality_conditions({jobs.c.state: state, jobs.c.hand: hand, jobs.c.object: object})
        query = select(jobs).where(*database.scope_conditions(scope, jobs), *same)
        query = query.where(jobs.c.id.startswith(prefix, autoescape=True)) if prefix else query
        query = query.where(*(_contains_word(word, owners) for word, owners in words.items()))
        page = partial(database.page_rows, descending=descending, **part)
        with self.database.read_transaction() as connection:
            key: ColumnElement[Any] = jobs.c[sort] if sort != "duration" else _duration(connection)
            rows, following = page(connection, query.add_columns(key) if sort == "duration" else query, key, jobs.c.id)
            return Page(items=_job_views(connection, rows), next=following)

    def get(self, job_id: str, *, details: bool = False, scope: ProjectScope = EVERYTHING) -> JobView:
        """Return a job; with `details`, and if it found too few grasps, also outcomes, phases and times."""
        with self.database.read_transaction() as connection:
            query = select(jobs).where(jobs.c.id == job_id, *database.scope_conditions(scope, jobs))
            (view,) = _job_views(connection, [self.database.first_row(query, f"job {job_id!r}", connection)])
            if view.note is None and not details and not view.request.second_engines:
                return view
            own = tasks.c.job_id == job_id
            infos = _infos_of(connection, own)
            used = select(tasks.c.device, func.sum(tasks.c.seconds)).where(own, tasks.c.done, ~_REUSED)
            seconds = {str(device): float(spent or 0) for device, spent in connection.execute(used.group_by("device"))}
            found = {"outcomes": _sum_infos(infos), "phases": phase_seconds(*infos), "seconds_by_device": seconds}
            if view.request.second_engines:
                found |= sum_outcomes(info.get("second_engine") or {} for info in infos)
            if view.request.has_episodes:
                made = _parts_of_manifests(connection, own, "episodes", Stage.EPISODE)
                found["episodes"] = dict(Counter(outcome for part in made for outcome in part.values()))
            return view.model_copy(update=found)

    def unfinished(self, ids: Collection[str]) -> set[str]:
        query = select(jobs.c.id).where(jobs.c.finished.is_(None))
        return {row.id for row in self.database.matching_rows(query, jobs.c.id, ids)}

    def tasks(self, *, job: str, state: State | None = None, limit: int = 50) -> Page[TaskView]:
        query = select(tasks).where(tasks.c.job_id == job, *_equality_conditions({tasks.c.state: state}))
        key = (tasks.c.job_id, tasks.c.batch, tasks.c.position)
        with self.database.read_transaction() as connection:
            rows, following = database.page_rows(connection, query, *key, limit=limit, descending=False)
        return Page(items=[_task_view(row) for row in rows], next=following)

    def task(self, task_id: str, *, scope: ProjectScope = EVERYTHING) -> TaskView:
        query = select(tasks).where(tasks.c.id == task_id, *database.scope_conditions_by_job(scope, tasks))
        return _task_view(self.database.first_row(query, f"task {task_id!r}"))

    def tasks_out_of_scope(self, task_ids: Collection[str], scope: ProjectScope) -> set[str]:
        query = select(tasks.c.id).join(jobs, jobs.c.id == tasks.c.job_id).where(jobs.c.project != scope.project)
        return {row.id for row in self.database.matching_rows(query, tasks.c.id, task_ids)}

    def attempts(self, *, job: str | None = None, limit: int = 50) -> list[AttemptView]:
        query = select(attempts).where(*_equality_conditions({attempts.c.job_id: job}))
        query = query.order_by(attempts.c.ended.desc(), attempts.c.number.desc()).limit(database.page_size(limit))
        return [AttemptView(**row) for row in self.database.rows(query)]


def _duration(connection: Connection) -> ColumnElement[float]:
    return literal_column(_DURATION[connection.dialect.name], Float()).label("duration")


def _contains_word(word: str, owners: Collection[str]) -> ColumnElement[bool]:
    of_datasets = select(dataset_cells.c.job_id).where(dataset_cells.c.dataset.icontains(word, autoescape=True))
    named = jobs.c.hand.icontains(word, autoescape=True) | jobs.c.object.icontains(word, autoescape=True)
    begins = jobs.c.id.startswith(word.lower(), autoescape=True)
    return named | begins | jobs.c.id.in_(of_datasets) | jobs.c.owner.in_(owners)


def _equality_conditions(wanted: Mapping[Column[Any], str | None]) -> list[ColumnElement[bool]]:
    return [column == value for column, value in wanted.items() if value is not None]


def _job_views(connection: Connection, rows: Sequence[Any]) -> list[JobView]:
    ids = [row["id"] for row in rows]
    progress = _stage_progress_by_job(connection, ids)
    made = _grasp_counts(connection, ids)
    views = []
    for row in rows:
        view = JobView(**row, stages=progress[row["id"]], **made.get(row["id"], {}))
        number = count_ranges(view.request.grasps, row["span"])
        views.append(view.model_copy(update={"stages": [_with_pending_tasks(one, number) for one in view.stages]}))
    return views


def _with_pending_tasks(stage: StageProgress, tasks: int) -> StageProgress:
    """Count the tasks of a large job that the index does not have yet as queued."""
    more = max(0, tasks - stage.tasks)
    return stage.model_copy(update={"tasks": stage.tasks + more, "queued": stage.queued + more}) if more else stage


def _stage_progress_by_job(connection: Connection, ids: Sequence[str]) -> dict[str, list[StageProgress]]:
    group = (tasks.c.job_id, tasks.c.position, tasks.c.stage, tasks.c.state)
    query = select(
        *group,
        func.count().label("tasks"),
        func.sum(cast(SHARE_DONE, Float)).label("done"),
        func.sum(case((_REUSED, 0.0), else_=func.coalesce(tasks.c.seconds, 0.0))).label("seconds"),
        func.sum(case((_REUSED, 1), else_=0)).label("reused"),
    )
    query = query.where(tasks.c.job_id.in_(ids)).group_by(*group)
    stages: dict[str, dict[int, dict[str, Any]]] = defaultdict(dict)
    for row in connection.execute(query).mappings():
        sums = {"tasks": 0, "done": 0.0, "seconds": 0.0, "reused": 0}
        stage = stages[row["job_id"]].setdefault(row["position"], {"stage": row["stage"], **sums})
        stage[row["state"]] = row["tasks"]
        for name in sums:
            stage[name] += row[name]
    return {job: [StageProgress(**stages[job][position]) for position in sorted(stages[job])] for job in ids}


def _grasp_counts(connection: Connection, ids: Sequence[str]) -> dict[str, dict[str, int]]:
    same = ("valid", "candidates", "validated", "rechecked", "recheck_held")
    columns = {"grasps": "count", **{name: name for name in same}}
    sums = (func.sum(shards.c[column]).label(name) for name, column in columns.items())
    query = select(tasks.c.job_id, *sums).join(shards, shards.c.id == tasks.c.shard_id).group_by(tasks.c.job_id)
    query = query.where(tasks.c.job_id.in_(ids), tasks.c.stage == Stage.SYNTHESIZE.value)
    rows = connection.execute(query).mappings()
    return {row["job_id"]: {name: int(row[name]) for name in columns} for row in rows}


def _task_view(row: Any) -> TaskView:
    attempt = row["last_attempt"] + (not State(row["state"]).is_final or row["last_attempt"] == 0)
    progress = {name: row[f"progress_{name}"] for name in ("done", "total", "message")}
    return TaskView.model_validate({**row, **progress, "attempt": attempt})


#: Maximum number of shards to read for outcomes, which keeps a page fast.
MOST_SHARDS: Final = 1000


def outcomes_of(connection: Connection, of_jobs: ColumnElement[bool]) -> dict[str, int]:
    """Count rejected candidates by outcome in at most `MOST_SHARDS` shards of the selected jobs."""
    return _sum_infos(_infos_of(connection, of_jobs))


def _infos_of(connection: Connection, of_jobs: ColumnElement[bool]) -> list[dict[str, Any]]:
    return _parts_of_manifests(connection, of_jobs, "info", Stage.SYNTHESIZE)


def _parts_of_manifests(
    connection: Connection, of_jobs: ColumnElement[bool], name: str, stage: Stage
) -> list[dict[str, Any]]:
    query = select(shards.c.manifest[name]).join(tasks, tasks.c.shard_id == shards.c.id)
    query = query.where(of_jobs, tasks.c.stage == stage.value).limit(MOST_SHARDS)
    return [part for part in connection.scalars(query) if isinstance(part, dict)]


def _sum_infos(infos: Sequence[Mapping[str, Any]]) -> dict[str, int]:
    return sum_outcomes(info.get("outcomes") or {} for info in infos)


class Shards(database.IndexPart):
    def page(
        self,
        *,
        job: str | None = None,
        kind: ShardKind | None = None,
        scope: ProjectScope = EVERYTHING,
        **part: Unpack[database.Paging],
    ) -> Page[ShardView]:
        """Return a page of shards, newest first, without their manifests."""
        query = select(shards).where(*database.shard_scope_conditions(scope, shards.c.id))
        query = query.where(*_equality_conditions({shards.c.kind: kind}))
        if job is not None:
            query = query.where(shards.c.id.in_(select(tasks.c.shard_id).where(tasks.c.job_id == job)))
        with self.database.read_transaction() as connection:
            key = shards.c.created, shards.c.id
            rows, following = database.page_rows(connection, query, *key, **part)
        return Page(items=[ShardView.model_validate({**row, "manifest": {}}) for row in rows], next=following)

    def assets_of(self, ids: Collection[str]) -> dict[str, tuple[str, str]]:
        query = select(shards.c.id, shards.c.hand_digest, shards.c.object_digest).where(shards.c.id.in_(ids))
        return {row["id"]: (row["hand_digest"], row["object_digest"]) for row in self.database.rows(query)}

    def job_of(self, shard_id: str, *, scope: ProjectScope = EVERYTHING) -> str | None:
        """Return a job in scope that requested this shard; None if the index has none."""
        in_scope = database.scope_conditions_by_job(scope, tasks)
        query = select(tasks.c.job_id).where(tasks.c.shard_id == shard_id, *in_scope)
        found: str | None = self.database.value(query.limit(1))
        return found

    def episodes_of(self, base: str, *, scope: ProjectScope = EVERYTHING) -> list[ShardView]:
        """Return the shards of episodes of a base shard's grasps, newest first."""
        own = tasks.alias()
        same = (own.c.job_id == tasks.c.job_id, own.c.batch == tasks.c.batch, own.c.shard_id == base)
        query = select(shards).join(tasks, tasks.c.shard_id == shards.c.id).join(own, and_(*same))
        query = query.where(tasks.c.stage == Stage.EPISODE.value, *database.scope_conditions_by_job(scope, tasks))
        rows = self.database.rows(query.order_by(shards.c.created.desc(), shards.c.id))
        return list({row["id"]: ShardView(**row) for row in rows}.values())

    def get(self, shard_id: str, *, scope: ProjectScope = EVERYTHING) -> ShardView:
        query = select(shards).where(shards.c.id == shard_id, *database.shard_scope_conditions(scope, shards.c.id))
        return ShardView(**self.database.first_row(query, f"shard {shard_id!r}"))
