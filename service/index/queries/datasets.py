"""Queries of datasets, their cells and snapshots."""

from collections import defaultdict
from collections.abc import Collection, Sequence
from typing import Any, Final, Unpack

from sqlalchemy import ColumnElement, Connection, Float, case, cast, func, literal, select

from graspd.service.index.database import IndexPart, Paging, page_rows, scope_conditions
from graspd.service.index.queries.jobs import SHARE_DONE, outcomes_of
from graspd.service.index.tables import attempts, dataset_cells, dataset_snapshots, datasets, jobs, shards, tasks
from graspd.service.index.views import CellView, DatasetView, Page, SnapshotView
from graspd.service.model.domain import JobOptions
from graspd.service.model.errors import SEARCHED, NotFoundError, available_names
from graspd.service.model.planning import count_ranges, explain_shortfall, job_state, stages_of
from graspd.service.model.projects import EVERYTHING, ProjectScope
from graspd.service.model.records import SnapshotShard
from graspd.service.model.states import Stage, State

_IS_BASE: Final = shards.c.stage == Stage.SYNTHESIZE.value


class Datasets(IndexPart):
    def page(self, *, scope: ProjectScope = EVERYTHING, **part: Unpack[Paging]) -> Page[DatasetView]:
        query, key = select(datasets).where(*scope_conditions(scope, datasets)), (datasets.c.created, datasets.c.name)
        with self.database.read_transaction() as connection:
            rows, following = page_rows(connection, query, *key, **part)
            return Page(items=[_dataset_view(connection, row) for row in rows], next=following)

    def get(self, name: str, *, scope: ProjectScope = EVERYTHING) -> DatasetView:
        with self.database.read_transaction() as connection:
            view = _dataset_view(connection, _dataset_row(connection, name, scope))
            if view.reason is None:
                return view
            cells = select(dataset_cells.c.job_id).where(dataset_cells.c.dataset == name)
            return view.model_copy(update={"outcomes": outcomes_of(connection, tasks.c.job_id.in_(cells))})

    def users_of(self, digests: Collection[str], *, scope: ProjectScope = EVERYTHING) -> dict[str, list[str]]:
        """Return the names of the datasets in scope that use each hand or object, by its digest."""
        used: dict[str, list[str]] = {digest: [] for digest in digests}
        for column in (dataset_cells.c.hand_digest, dataset_cells.c.object_digest):
            query = select(column.label("digest"), dataset_cells.c.dataset).distinct().where(column.in_(digests))
            query = query.join(datasets, datasets.c.name == dataset_cells.c.dataset)
            query = query.where(*scope_conditions(scope, datasets)).order_by(dataset_cells.c.dataset)
            for row in self.database.rows(query):
                used[row["digest"]].append(row["dataset"])
        return used

    def unfinished(self, names: Collection[str]) -> set[str]:
        query = select(datasets).where(datasets.c.name.in_(sorted(names)))
        with self.database.read_transaction() as connection:
            rows = connection.execute(query).mappings().all()
            return {row["name"] for row in rows if not _has_ended(connection, row)}

    def ended_event_counts(self, *, within: Connection) -> dict[str, int]:
        rows = self.database.rows(select(datasets), within)
        return {row["name"]: row["events"] for row in rows if _has_ended(within, row)}

    def cells(
        self, name: str, *, state: State | None = None, scope: ProjectScope = EVERYTHING, **part: Unpack[Paging]
    ) -> Page[CellView]:
        with self.database.read_transaction() as connection:
            dataset = _dataset_row(connection, name, scope)
            now = _cell_state(dataset["cancelled"])
            planned = jobs.c.id.is_not(None).label("planned")
            query = select(dataset_cells, now.label("state"), planned, jobs.c.reason, jobs.c.span)
            query = query.outerjoin(jobs, jobs.c.id == dataset_cells.c.job_id).where(dataset_cells.c.dataset == name)
            if state is not None:
                query = query.where(now == state.value)
            key = dataset_cells.c.position
            rows, following = page_rows(connection, query, key, descending=False, **part)
            views = _cell_views(connection, rows, JobOptions.model_validate(dataset["options"]))
        return Page(items=views, next=following)

    def shards(self, name: str) -> list[SnapshotShard]:
        """Return all shards of a dataset, ordered by cell, batch and stage."""
        query = select(*(shards.c[field] for field in SnapshotShard.model_fields))
        query = query.join(tasks, tasks.c.shard_id == shards.c.id).where(dataset_cells.c.dataset == name)
        query = query.join(dataset_cells, dataset_cells.c.job_id == tasks.c.job_id)
        query = query.order_by(dataset_cells.c.position, tasks.c.batch, tasks.c.position)
        with self.database.read_transaction() as connection:
            _dataset_row(connection, name)
            return [SnapshotShard(**row) for row in connection.execute(query).mappings()]

    def snapshots(self, name: str, *, scope: ProjectScope = EVERYTHING, **part: Unpack[Paging]) -> Page[SnapshotView]:
        query = select(dataset_snapshots).where(dataset_snapshots.c.dataset == name)
        key = (dataset_snapshots.c.created, dataset_snapshots.c.digest)
        with self.database.read_transaction() as connection:
            _dataset_row(connection, name, scope)
            rows, following = page_rows(connection, query, *key, **part)
        return Page(items=[SnapshotView(**row) for row in rows], next=following)


def _dataset_row(connection: Connection, name: str, scope: ProjectScope = EVERYTHING) -> Any:
    query = select(datasets).where(datasets.c.name == name, *scope_conditions(scope, datasets))
    row = connection.execute(query).mappings().first()
    if row is None:
        known = select(datasets.c.name).where(*scope_conditions(scope, datasets)).order_by(datasets.c.created.desc())
        names = list(connection.scalars(known.limit(SEARCHED)))
        raise NotFoundError(f"there is no dataset {name!r}{available_names(name, names)}")
    return row


def _cell_state(cancelled: bool) -> ColumnElement[str]:
    """Return the state of a cell: that of its job, or without a job queued or cancelled."""
    # A literal: PostgreSQL does not match an expression with parameters to the same expression in GROUP BY.
    unplanned = literal((State.CANCELLED if cancelled else State.QUEUED).value, literal_execute=True)
    return func.coalesce(jobs.c.state, unplanned)


def _dataset_view(connection: Connection, row: Any) -> DatasetView:
    options = JobOptions.model_validate(row["options"])
    states = _cell_counts_by_state(connection, row)
    state = _dataset_state(row, states)
    work = _task_counts(connection, dataset_cells.c.dataset == row["name"])
    made = _grasp_counts(connection, dataset_cells.c.dataset == row["name"])
    tasks_asked = max(work["tasks"], _count_tasks_of_dataset(connection, row["name"], options))
    left = tasks_asked - work["share"]
    pace = made["seconds"] / work["done"] if work["done"] else None
    return DatasetView(
        **{name: row[name] for name in ("name", "digest", "cells", "created", "owner", "project", "cancelled")},
        hands=[member["name"] for member in row["hands"]],
        objects=[member["name"] for member in row["objects"]],
        options=options,
        state=state,
        states=states,
        asked=row["cells"] * options.grasps,
        tasks=tasks_asked,
        tasks_done=work["done"],
        tasks_failed=work["failed"],
        progress=min(1.0, work["share"] / tasks_asked),
        eta_s=left * pace / work["running"] if pace is not None and work["running"] else None,
        finished=work["finished"] if state.is_final else None,
        **made,
    )


def _dataset_state(row: Any, states: dict[State, int]) -> State:
    state = job_state(state for state, count in states.items() if count)
    if row["cancelled"]:
        # Jobs of a cancelled dataset stop, or continue for another dataset.
        return state if state.is_final else State.CANCELLED
    # After a retry, a dataset counts as queued until its jobs have received that event.
    return State.QUEUED if state.is_final and row["applied"] < row["events"] else state


def _has_ended(connection: Connection, row: Any) -> bool:
    return _dataset_state(row, _cell_counts_by_state(connection, row)).is_final


def _cell_counts_by_state(connection: Connection, row: Any) -> dict[State, int]:
    now = _cell_state(row["cancelled"])
    query = select(now, func.count()).select_from(dataset_cells).where(dataset_cells.c.dataset == row["name"])
    query = query.outerjoin(jobs, jobs.c.id == dataset_cells.c.job_id).group_by(now)
    found = {State(state): int(count) for state, count in connection.execute(query)}
    return {state: found.get(state, 0) for state in State}


def _count_tasks_of_cell(options: JobOptions, span: int | None) -> int:
    """Return the number of tasks of a cell; `span`: batches per task, None (used as 1) without a job."""
    return count_ranges(options.grasps, span or 1) * len(stages_of(options))


def _count_tasks_of_dataset(connection: Connection, name: str, options: JobOptions) -> int:
    query = select(jobs.c.span, func.count()).select_from(dataset_cells)
    query = query.outerjoin(jobs, jobs.c.id == dataset_cells.c.job_id).where(dataset_cells.c.dataset == name)
    found = connection.execute(query.group_by(jobs.c.span))
    return sum(count * _count_tasks_of_cell(options, span) for span, count in found)


def _task_counts(connection: Connection, where: ColumnElement[bool]) -> dict[str, Any]:
    query = select(
        func.count().label("tasks"),
        _sum_where(tasks.c.state == State.SUCCEEDED.value, 1).label("done"),
        _sum_where(tasks.c.state == State.FAILED.value, 1).label("failed"),
        _sum_where(tasks.c.state == State.RUNNING.value, 1).label("running"),
        func.coalesce(func.sum(cast(SHARE_DONE, Float)), 0.0).label("share"),
        func.max(tasks.c.finished).label("finished"),
    )
    query = query.select_from(dataset_cells.join(tasks, tasks.c.job_id == dataset_cells.c.job_id)).where(where)
    return dict(connection.execute(query).mappings().one())


def _grasp_counts(connection: Connection, where: ColumnElement[bool]) -> dict[str, Any]:
    of_cells = dataset_cells.join(tasks, tasks.c.job_id == dataset_cells.c.job_id)
    query = select(*_MADE).select_from(of_cells.join(shards, shards.c.id == tasks.c.shard_id)).where(where)
    return dict(connection.execute(query).mappings().one())


def _cell_views(connection: Connection, rows: Sequence[Any], options: JobOptions) -> list[CellView]:
    ids = [row["job_id"] for row in rows]
    work = _task_counts_by_job(connection, ids)
    made = _grasp_counts_by_job(connection, ids)
    failed = select(attempts.c.job_id, func.count()).where(attempts.c.job_id.in_(ids)).group_by(attempts.c.job_id)
    failures = {job: int(count) for job, count in connection.execute(failed)}
    views = []
    for row in rows:
        job = row["job_id"]
        count = work[job]
        total = max(count["tasks"], _count_tasks_of_cell(options, row["span"]))
        yields = made.get(job, {"seconds": 0.0})
        found = yields.get("valid" if options.counted_status == "valid" else "grasps", 0)
        reason = row["reason"]
        if row["state"] == State.SUCCEEDED.value and options.want == "valid" and found < options.grasps:
            rejected, candidates = outcomes_of(connection, tasks.c.job_id == job), yields.get("candidates", 0)
            reason = explain_shortfall(options, found, candidates, rejected)
        views.append(
            CellView(
                **{name: row[name] for name in ("position", "hand", "object", "job_id", "state", "planned", "choice")},
                reason=reason,
                fidelity=row["fidelity"] or options.resolved_fidelity.name,
                asked=options.grasps,
                **yields,
                tasks=total,
                tasks_done=count[State.SUCCEEDED],
                tasks_failed=count[State.FAILED],
                attempts_failed=failures.get(job, 0),
                progress=min(1.0, count["share"] / total),
            )
        )
    return views


def _task_counts_by_job(connection: Connection, ids: Sequence[str]) -> dict[str, dict[str, float]]:
    query = select(tasks.c.job_id, tasks.c.state, func.count(), func.sum(cast(SHARE_DONE, Float)))
    query = query.where(tasks.c.job_id.in_(ids)).group_by(tasks.c.job_id, tasks.c.state)
    found: dict[str, dict[str, float]] = defaultdict(lambda: defaultdict(int))
    for job, state, count, share in connection.execute(query):
        found[job][State(state)] += count
        found[job]["tasks"] += count
        found[job]["share"] += share
    return found


def _grasp_counts_by_job(connection: Connection, ids: Sequence[str]) -> dict[str, dict[str, Any]]:
    wanted = [column for column in _MADE if column.name in ("grasps", "valid", "candidates", "validated", "seconds")]
    query = select(tasks.c.job_id, *wanted).join(shards, shards.c.id == tasks.c.shard_id)
    query = query.where(tasks.c.job_id.in_(ids)).group_by(tasks.c.job_id)
    return {row["job_id"]: {k: row[k] for k in row if k != "job_id"} for row in connection.execute(query).mappings()}


def _sum_where(condition: ColumnElement[bool], value: ColumnElement[int] | int) -> ColumnElement[int]:
    return func.coalesce(func.sum(case((condition, value), else_=0)), 0)


_MADE: Final = (
    func.count().label("shards"),
    func.coalesce(func.sum(shards.c.size_bytes), 0).label("size_bytes"),
    func.coalesce(func.sum(shards.c.seconds), 0.0).label("seconds"),
    _sum_where(_IS_BASE, shards.c.count).label("grasps"),
    *(_sum_where(_IS_BASE, shards.c[name]).label(name) for name in ("valid", "candidates", "validated")),
)
