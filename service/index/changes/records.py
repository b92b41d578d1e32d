"""Idempotent changes of rows by API and controller: jobs and datasets, states of tasks and workers."""

import json
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from itertools import groupby
from typing import Any, Final

from sqlalchemy import ColumnElement, Connection, Table, delete, exists, func, literal, select, tuple_, update

from graspd.service.index.database import IndexPart, chunks, rows_in, update_rows, upsert
from graspd.service.index.outbox import append_end_events
from graspd.service.index.tables import (
    assets,
    attempts,
    dataset_cells,
    dataset_snapshots,
    datasets,
    grasps,
    jobs,
    notes,
    object_sets,
    shards,
    tasks,
    workers,
)
from graspd.service.model import planning, records
from graspd.service.model.domain import Asset, JobOptions
from graspd.service.model.errors import LoadError, SceneError
from graspd.service.model.messages import WorkerHeartbeat
from graspd.service.model.states import State
from graspd.service.store.manifests import ShardManifest

Row = dict[str, Any]
#: Limits of facts [bytes], repairs and texts of a hand or object, because uploads are untrusted.
_MOST_FACTS: Final = 64 << 10
_MOST_REPAIRS: Final = 100
_LONGEST_TEXT: Final = 2000


def job_row(record: records.JobRecord) -> Row:
    others = {
        "state": State.QUEUED.value,
        "priority": record.priority.value,
        "hand": record.request.hand,
        "object": record.request.object,
        "request": record.request.model_dump(mode="json"),
        "revisions": dict(record.revisions),
        "origin": record.origin and record.origin.model_dump(exclude_defaults=True),
        "cancelled": False,
        "finished": None,
        "reason": None,
        "neighbours": neighbour_digests(record.request),
        "choice": record.choice and record.choice.model_dump(),
        "network_digest": record.request.network,
    }
    return row_from(jobs, record, **others)


def neighbour_digests(options: JobOptions) -> str:
    return " ".join(dict.fromkeys(one.digest or "" for one in options.all_neighbours))


NO_PROGRESS: Final = {"progress_done": 0.0, "progress_total": 0.0, "progress_message": None}
_UNSTARTED: Final = {
    "state": State.QUEUED.value,
    **dict.fromkeys(("ready", "done", "exhausted", "queued"), False),
    **dict.fromkeys(("last_attempt", "retried_upto"), 0),
    **dict.fromkeys(("reason", "worker", "device", "seconds", "finished")),
    "not_before": 0.0,
    **NO_PROGRESS,
}


def task_rows(record: records.JobRecord, ranges: range | None = None) -> Iterator[Row]:
    order = planning.stages_of(record.request)
    for task in planning.plan_tasks(record, ranges):
        yield {
            "id": task.id,
            "job_id": record.id,
            "stage": task.stage.value,
            "batch": task.batch,
            "position": order.index(task.stage),
            "count": task.count,
            "priority": record.priority.value,
            "inputs": list(task.inputs),
            "shard_id": task.output,
            "created": record.created,
            **_UNSTARTED,
        }


def sanitize(text: str, length: int | None = None) -> str:
    """Return text without NUL and cut to `length`, because PostgreSQL rejects both."""
    return text.replace("\0", "")[:length]


def row_from(table: Table, record: object, **others: Any) -> Row:
    """Return a row of a record's attributes; `others` replace some. Text is cut to the column's length."""
    row = {column.name: getattr(record, column.name) for column in table.columns if column.name not in others} | others
    lengths = {column.name: getattr(column.type, "length", None) for column in table.columns}
    return {name: sanitize(value, lengths[name]) if isinstance(value, str) else value for name, value in row.items()}


def shard_row(manifest: ShardManifest) -> Row:
    content = manifest.model_dump(mode="json", exclude={"grasps": True, "info": {"log"}})
    others = {"id": manifest.shard_id, "stage": manifest.stage.value, "inputs": list(manifest.inputs)}
    return row_from(shards, manifest, charged="", manifest=content, **others)


def grasp_rows(manifest: ShardManifest) -> list[Row]:
    of_shard = {
        "shard_id": manifest.shard_id,
        "hand": manifest.hand,
        "object": manifest.object,
        "scene_kind": manifest.request.scene_spec.kind,
        "neighbours": len(manifest.request.all_neighbours),
        "created": manifest.created,
    }
    return [of_shard | {"row": row} | grasp.model_dump() for row, grasp in enumerate(manifest.grasps)]


def asset_row(asset: Asset, check: Mapping[str, Any] | None) -> Row:
    """Return the row of a hand, object or network; a built-in asset counts as accepted without a check."""
    found = check or ({"verdict": "accept"} if asset.builtin else {})
    others = {
        "kind": asset.kind.value,
        "files": list(asset.files),
        "verdict": found.get("verdict"),
        "message": found.get("message") and sanitize(found["message"], _LONGEST_TEXT),
        "repairs": [sanitize(str(one), _LONGEST_TEXT) for one in (found.get("repairs") or [])[:_MOST_REPAIRS]],
        "facts": _limited_facts({**asset.facts, **(found.get("facts") or {})}),
        "last_attempt": 0,
        "queued": False,
        "not_before": 0.0,
    }
    return row_from(assets, asset, **others)


def _limited_facts(facts: dict[str, Any]) -> dict[str, Any]:
    """Return all facts, or at most 100 numbers if the facts are too long; `check.json` has the others."""
    if len(json.dumps(facts)) <= _MOST_FACTS:
        return facts
    return {name[:100]: value for name, value in list(facts.items())[:100] if isinstance(value, int | float)}


#: Maximum number of jobs whose states are derived together.
_JOBS_AT_ONCE: Final = 200
_FACTS: Final = ("stage", "done", "last_attempt", "exhausted", "retried_upto")

#: Execution option of a connection: ends of jobs are not appended to the outbox.
QUIET: Final = "graspd_quiet"
#: Prefix of notes about jobs with tasks not yet in the index; the job's id follows.
ENTERING: Final = "entering "
_WHOSE: Final = (jobs.c.project, jobs.c.owner)


def derive_states(connection: Connection, job_id: str, batches: Collection[int] | None = None) -> State:
    """Derive the states of a job and of its tasks in some batches (None: all); return the job's state."""
    return derive_task_and_job_states(connection, {job_id: batches})[job_id]


def derive_task_and_job_states(
    connection: Connection, touched: Mapping[str, Collection[int] | None]
) -> dict[str, State]:
    """Derive the states of jobs and of their tasks in some batches (None: all); return the jobs' states.

    If a job's first batch fails because of its scenes or the object's weight, its other batches are cancelled.
    """
    states: dict[str, State] = {}
    for some in chunks(list(touched), _JOBS_AT_ONCE):
        _derive_task_states(connection, {job: touched[job] for job in some})
        states |= _derive_job_states(connection, some)
    return states


def _derive_task_states(connection: Connection, touched: Mapping[str, Collection[int] | None]) -> None:
    query = select(jobs.c.id, jobs.c.cancelled, _first_batch_failed_condition()).where(jobs.c.id.in_(list(touched)))
    facts = {row.id: row for row in connection.execute(query)}
    cancelled = {job for job, row in facts.items() if row.cancelled or row.hopeless}
    whole = [job for job, batches in touched.items() if batches is None or (job in facts and facts[job].hopeless)]
    partly = {job: batches for job, batches in touched.items() if job not in whole}
    pairs = [(job, batch) for job, batches in partly.items() for batch in sorted(set(batches or ()))]
    conditions = [tasks.c.job_id.in_(some) for some in chunks(whole)]
    conditions += [tuple_(tasks.c.job_id, tasks.c.batch).in_(some) for some in chunks(pairs)]
    rows: list[Any] = []
    for wanted in conditions:
        query = select(*(tasks.c[name] for name in ("job_id", "id", "batch", "state", "ready", *_FACTS)))
        query = query.where(wanted).order_by(tasks.c.job_id, tasks.c.batch, tasks.c.position)
        rows += connection.execute(query).mappings()
    changes: defaultdict[tuple[str, bool], list[str]] = defaultdict(list)
    for (job, _), chain in groupby(rows, key=lambda row: (row["job_id"], row["batch"])):
        for task, state, ready in _changed_tasks(list(chain), cancelled=job in cancelled):
            changes[state, ready].append(task)
    for (state, ready), ids in changes.items():
        for some in chunks(ids):
            connection.execute(update(tasks).where(tasks.c.id.in_(some)).values(state=state, ready=ready))


def _first_batch_failed_condition() -> ColumnElement[bool]:
    """Return the condition that a job's first batch failed because of its scenes or the object's weight."""
    last = (attempts.c.task_id == tasks.c.id) & (attempts.c.number == tasks.c.last_attempt)
    failed = (tasks.c.done.is_(False), tasks.c.exhausted.is_(True), tasks.c.last_attempt > tasks.c.retried_upto)
    first = (tasks.c.job_id == jobs.c.id, tasks.c.batch == 0)
    return (
        exists()
        .select_from(tasks.join(attempts, last))
        .where(*first, *failed, attempts.c.kind.in_([SceneError.__name__, LoadError.__name__]))
        .correlate(jobs)
        .label("hopeless")
    )


def _changed_tasks(chain: Sequence[Any], *, cancelled: bool) -> list[tuple[str, str, bool]]:
    """Return the changed tasks of a batch, each with its new state and readiness."""
    facts = [
        planning.TaskFacts(running=row["state"] == State.RUNNING, **{name: row[name] for name in _FACTS})
        for row in chain
    ]
    states = planning.range_states(facts, job_cancelled=cancelled)
    return [
        (row["id"], state.value, ready)
        for row, state, ready in zip(chain, states, planning.range_ready_mask(states), strict=True)
        if (row["state"], row["ready"]) != (state.value, ready)
    ]


def _derive_job_states(connection: Connection, ids: Sequence[str]) -> dict[str, State]:
    # One index look-up per state: a query of distinct states would read every task of the job.
    of_job = tasks.c.job_id == jobs.c.id
    probes = [exists().where(of_job, tasks.c.state == state.value).label(state.value) for state in State]
    probes.append(exists().where(notes.c.name == literal(ENTERING) + jobs.c.id).label("entering"))
    query = select(jobs.c.id, jobs.c.state.label("now"), jobs.c.finished, jobs.c.reason, *_WHOSE, *probes)
    known = {row["id"]: row for row in connection.execute(query.where(jobs.c.id.in_(ids))).mappings()}
    states: dict[str, State] = {}
    ended: list[Row] = []
    for job in ids:
        row = known.get(job)
        found = [state for state in State if row is not None and row[state.value]]
        found += [State.QUEUED] if row is not None and row["entering"] else []
        state = states[job] = planning.job_state(found)
        if row is None:
            continue
        values: dict[str, Any] = {"state": state.value, "finished": None, "reason": None}
        if state.is_final:
            values["finished"] = connection.scalar(select(func.max(tasks.c.finished)).where(tasks.c.job_id == job))
        if State.FAILED in found:
            first = select(tasks.c.reason).where(tasks.c.job_id == job, tasks.c.state == State.FAILED.value)
            values["reason"] = connection.scalar(first.order_by(tasks.c.batch, tasks.c.position).limit(1))
        if values != {"state": row["now"], "finished": row["finished"], "reason": row["reason"]}:
            connection.execute(update(jobs).where(jobs.c.id == job).values(**values))
            if state.is_final and state != row["now"]:
                about = {"kind": "job", "subject": job, "state": state.value}
                ended.append(about | {"project": row["project"], "owner": row["owner"]})
    if not connection.get_execution_options().get(QUIET):
        append_end_events(connection, ended)
    return states


#: Maximum number of ranges per transaction, which takes some tenths of a second while other writers wait.
RANGES_AT_ONCE: Final = 500


class Changes(IndexPart):
    """Writes of jobs, shards, attempts and assets. `within` makes a write part of a larger transaction."""

    def add_job(self, record: records.JobRecord, *, within: Connection | None = None) -> State:
        """Add a job with all its tasks; tasks whose shard exists count as succeeded."""
        with self.database.write_transaction(within) as connection:
            self._upsert_job(connection, record)
            self._upsert_tasks(connection, list(task_rows(record)))
            return derive_states(connection, record.id)

    def enter_job(self, record: records.JobRecord, *, within: Connection) -> None:
        """Add a job with its first `RANGES_AT_ONCE` ranges of tasks; `enter_next_tasks` adds the other ones."""
        is_new = within.scalar(select(jobs.c.id).where(jobs.c.id == record.id)) is None
        self._upsert_job(within, record)
        self._enter_ranges(within, record, 0, goes_on=is_new)

    def partly_entered_jobs(self) -> list[str]:
        """Return the ids of jobs with tasks that are not yet in the index."""
        query = select(notes.c.name).where(notes.c.name.startswith(ENTERING)).order_by(notes.c.name)
        return [name.removeprefix(ENTERING) for name in self.database.column(query)]

    def enter_next_tasks(self, job_id: str, record: records.JobRecord | None) -> None:
        """Add the next tasks of a large job; without a record (None), for example after a deletion, stop."""
        with self.database.write_transaction() as connection:
            exists_now = connection.scalar(select(jobs.c.id).where(jobs.c.id == job_id)) is not None
            note: Any = connection.scalar(select(notes.c.value).where(notes.c.name == ENTERING + job_id))
            if record is None or not exists_now:
                connection.execute(delete(notes).where(notes.c.name == ENTERING + job_id))
            elif note is not None:
                self._enter_ranges(connection, record, note["range"], goes_on=True)

    def add_manifests(
        self, manifests: Iterable[ShardManifest], *, within: Connection | None = None
    ) -> dict[str, State]:
        """Add shards with their grasps, and mark their tasks as succeeded; return the states of their jobs."""
        new = {manifest.shard_id: manifest for manifest in manifests}
        touched: defaultdict[str, set[int]] = defaultdict(set)
        with self.database.write_transaction(within) as connection:
            charged = self._requesting_projects(connection, list(new))
            rows = [shard_row(manifest) | {"charged": charged.get(shard, "")} for shard, manifest in new.items()]
            upsert(connection, shards, rows, keep=("charged",))
            upsert(connection, grasps, [row for manifest in new.values() for row in grasp_rows(manifest)])
            for some in chunks(list(new)):
                made = update(tasks).where(tasks.c.shard_id == shards.c.id, shards.c.id.in_(some))
                made = made.values(_finished_task_columns(*_OUTCOME)).returning(tasks.c.job_id, tasks.c.batch)
                for job, batch in connection.execute(made):
                    touched[job].add(batch)
            return derive_task_and_job_states(connection, touched)

    def add_attempt(
        self, attempt: records.AttemptRecord, *, not_before: float = 0.0, within: Connection | None = None
    ) -> State | None:
        """Add a failed attempt; the next is due at `not_before` [s]. Return the job's state, if changed."""
        with self.database.write_transaction(within) as connection:
            if connection.scalar(select(tasks.c.id).where(tasks.c.id == attempt.task_id)) is None:
                return None  # The job was deleted, or the attempt is forged.
            upsert(connection, attempts, [row_from(attempts, attempt, stage=attempt.stage.value)])
            values: dict[str, Any] = {
                "last_attempt": attempt.number,
                "exhausted": attempt.last,
                "reason": sanitize(attempt.reason),
                "finished": attempt.ended if attempt.last else None,
                "worker": sanitize(attempt.worker, 128) if attempt.last else None,
            }
            values |= {"state": State.QUEUED.value, "queued": False, "not_before": not_before, **NO_PROGRESS}
            is_next = (tasks.c.done.is_(False), tasks.c.last_attempt < attempt.number)
            changed = update(tasks).where(tasks.c.id == attempt.task_id, *is_next).values(**values)
            touched = connection.execute(changed.returning(tasks.c.job_id, tasks.c.batch)).first()
            return None if touched is None else derive_states(connection, touched.job_id, [touched.batch])

    def set_job_events(
        self, job_id: str, events: Sequence[records.JobEvent], *, within: Connection | None = None
    ) -> State:
        """Apply the complete list of a job's events, oldest first, to the job and its tasks."""
        cancelled = bool(events) and events[-1].what == "cancelled"
        with self.database.write_transaction(within) as connection:
            connection.execute(update(jobs).where(jobs.c.id == job_id).values(cancelled=cancelled))
            for event in events:
                for task_id, upto in event.retried.items():
                    task = (tasks.c.id == task_id, tasks.c.done.is_(False), tasks.c.retried_upto < upto)
                    fresh = {"reason": None, "finished": None, "worker": None, "queued": False, "not_before": 0.0}
                    connection.execute(update(tasks).where(*task, tasks.c.last_attempt <= upto).values(**fresh))
                    connection.execute(update(tasks).where(*task).values(retried_upto=upto))
            return derive_states(connection, job_id)

    def add_asset(self, asset: Asset, check: Mapping[str, Any] | None, *, within: Connection | None = None) -> None:
        """Add an asset with the result of its check, None while the check is pending."""
        with self.database.write_transaction(within) as connection:
            upsert(connection, assets, [asset_row(asset, check)], keep=("last_attempt", "queued", "not_before"))

    def _upsert_job(self, connection: Connection, record: records.JobRecord) -> None:
        upsert(connection, jobs, [job_row(record)], keep=("state", "cancelled", "finished", "reason"))

    def _upsert_tasks(self, connection: Connection, rows: list[Row]) -> None:
        query, ids = select(shards.c.id, *_OUTCOME), [row["shard_id"] for row in rows]
        known = {shard: _finished_task_columns(*made) for shard, *made in rows_in(connection, query, shards.c.id, ids)}
        for row in rows:
            row.update(known.get(row["shard_id"], {}))
        upsert(connection, tasks, rows, keep=[name for name in rows[0] if name != "priority"])

    def _enter_ranges(self, connection: Connection, record: records.JobRecord, first: int, *, goes_on: bool) -> None:
        """Add up to `RANGES_AT_ONCE` ranges from `first`; with `goes_on`, note the next range, if any."""
        number = planning.count_ranges(record.request.grasps, record.span)
        some = range(first, min(number, first + RANGES_AT_ONCE))
        self._upsert_tasks(connection, list(task_rows(record, some)))
        if goes_on and some.stop < number:
            upsert(connection, notes, [{"name": ENTERING + record.id, "value": {"range": some.stop}}])
        elif goes_on:
            connection.execute(delete(notes).where(notes.c.name == ENTERING + record.id))
        derive_states(connection, record.id, [number * record.span for number in some])

    def _requesting_projects(self, connection: Connection, ids: Sequence[str]) -> dict[str, str]:
        """Map each requested shard to the project of the oldest job that requested it."""
        found: dict[str, str] = {}
        query = select(tasks.c.shard_id, jobs.c.project).join(jobs, jobs.c.id == tasks.c.job_id)
        oldest_first = query.order_by(jobs.c.created, jobs.c.id)
        for shard, project in rows_in(connection, oldest_first, tasks.c.shard_id, ids):
            found.setdefault(shard, project)
        return found


_OUTCOME = (shards.c.worker, shards.c.device, shards.c.seconds, shards.c.created)


def _finished_task_columns(worker: Any, device: Any, seconds: Any, created: Any) -> dict[str, Any]:
    """Return the columns of a task row that follow from its shard, given as values or as SQL columns."""
    made = {"done": True, "worker": worker, "device": device, "seconds": seconds, "finished": created}
    return {**made, "reason": None, "queued": False, "not_before": 0.0, **NO_PROGRESS}


class DatasetChanges(IndexPart):
    """Writes of datasets. `within` makes a write part of a larger transaction."""

    def add(self, record: records.DatasetRecord, *, within: Connection | None = None) -> None:
        row = {
            **{name: getattr(record, name) for name in ("name", "digest", "revisions", "created", "owner", "project")},
            "hands": [member.model_dump() for member in record.hands],
            "objects": [member.model_dump() for member in record.objects],
            "options": record.options.model_dump(mode="json"),
            "cells": len(record.jobs),
            "cancelled": False,
            "events": 0,
            "applied": 0,
            "planned": False,
            "neighbours": neighbour_digests(record.options),
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
        with self.database.write_transaction(within) as connection:
            upsert(connection, datasets, [row], keep=("cancelled", "events", "applied", "planned"))
            upsert(connection, dataset_cells, cells)

    def set_events(
        self, name: str, events: Sequence[records.DatasetEvent], *, within: Connection | None = None
    ) -> None:
        """Apply the complete list of a dataset's events, oldest first."""
        cancelled = bool(events) and events[-1].what == "cancelled"
        number = max((event.number for event in events), default=0)
        values = {"cancelled": cancelled, "events": number, "planned": False}
        with self.database.write_transaction(within) as connection:
            connection.execute(update(datasets).where(datasets.c.name == name).values(**values))

    def add_snapshot(self, snapshot: records.Snapshot, *, within: Connection | None = None) -> None:
        row = row_from(dataset_snapshots, snapshot, shards=len(snapshot.shards))
        with self.database.write_transaction(within) as connection:
            upsert(connection, dataset_snapshots, [row])

    def add_object_set(self, found: records.ObjectSet, *, within: Connection | None = None) -> None:
        row = row_from(object_sets, found, objects=list(found.objects))
        with self.database.write_transaction(within) as connection:
            upsert(connection, object_sets, [row])

    def set_progress(self, name: str, *, within: Connection | None = None, **values: int) -> None:
        with self.database.write_transaction(within) as connection:
            connection.execute(update(datasets).where(datasets.c.name == name).values(**values))


_UNFINISHED = tasks.c.state.in_((State.QUEUED.value, State.RUNNING.value))


class LiveChanges(IndexPart):
    def set_running(self, workers: Mapping[str, str]) -> dict[str, State]:
        """Mark queued tasks as running; `workers` maps tasks to workers. Return the states of their jobs."""
        running = State.RUNNING.value
        with self.database.write_transaction() as connection:
            waiting = select(tasks.c.id, tasks.c.job_id).where(tasks.c.state == State.QUEUED.value)
            jobs_of = {row.id: row.job_id for row in rows_in(connection, waiting, tasks.c.id, workers)}
            started = {"state": running, "queued": True, "progress_done": 0.0, "progress_total": 0.0}
            rows = [{"id": task, **started, "worker": sanitize(workers[task], 128)} for task in jobs_of]
            update_rows(connection, tasks, rows, state=State.QUEUED.value)
            touched = sorted(set(jobs_of.values()))
            for some in chunks(touched):
                of_waiting = update(jobs).where(jobs.c.id.in_(some), jobs.c.state == State.QUEUED.value)
                connection.execute(of_waiting.values(state=running))
            return dict.fromkeys(touched, State.RUNNING)

    def set_progress(self, progress: Mapping[str, tuple[float, float, str]]) -> None:
        rows = [
            {"id": task, "progress_done": done, "progress_total": total, "progress_message": sanitize(message)}
            for task, (done, total, message) in progress.items()
        ]
        with self.database.write_transaction() as connection:
            update_rows(connection, tasks, rows, state=State.RUNNING.value)

    def set_queued(self, task_ids: Sequence[str]) -> None:
        with self.database.write_transaction() as connection:
            for some in chunks(task_ids):
                connection.execute(update(tasks).where(tasks.c.id.in_(some), _UNFINISHED).values(queued=True))

    def set_waiting(
        self, task_ids: Sequence[str], *, not_before: float = 0.0, message: str | None = None
    ) -> dict[str, State]:
        """Mark unfinished tasks as waiting until `not_before` [Unix time, s]; return their jobs' states."""
        values = {"queued": False, "not_before": not_before, "state": State.QUEUED.value, "worker": None}
        values |= {**NO_PROGRESS, "progress_message": message and sanitize(message)}
        touched: set[str] = set()
        with self.database.write_transaction() as connection:
            for some in chunks(task_ids):
                statement = update(tasks).where(tasks.c.id.in_(some), _UNFINISHED).values(**values)
                touched |= set(connection.scalars(statement.returning(tasks.c.job_id)))
            return {job: derive_states(connection, job, []) for job in touched}

    def set_asset_waiting(
        self, digests: Iterable[str], *, queued: bool, not_before: float = 0.0, message: str | None = None
    ) -> None:
        """Set whether checks of assets are in the queue, their due time [Unix time, s], and a given message."""
        values: dict[str, Any] = {"queued": queued, "not_before": not_before}
        if message is not None:
            values["message"] = sanitize(message)
        with self.database.write_transaction() as connection:
            connection.execute(update(assets).where(assets.c.digest.in_(list(digests))).values(**values))

    def set_workers(self, beats: Sequence[WorkerHeartbeat], *, forget_before: str, lost_before: str = "9999") -> None:
        """Record living workers; mark others as lost or delete them, according to their last report."""
        rows = [
            row_from(workers, beat, stages=[stage.value for stage in beat.stages], task_id=beat.task_id or None)
            for beat in beats
        ]
        with self.database.write_transaction() as connection:
            upsert(connection, workers, rows)
            living = {beat.name for beat in beats}
            known = connection.execute(select(workers.c.name, workers.c.seen, workers.c.state)).all()
            gone = [row for row in known if row.name not in living]
            lost = [row.name for row in gone if row.seen < lost_before and row.state != "lost"]
            for some in chunks(lost):
                of_lost = update(workers).where(workers.c.name.in_(some))
                connection.execute(of_lost.values(state="lost", task_id=None, reason=""))
            self.delete_workers([row.name for row in gone if row.seen < forget_before], within=connection)

    def delete_workers(self, names: Sequence[str], *, within: Connection | None = None) -> None:
        with self.database.write_transaction(within) as connection:
            for some in chunks(names):
                connection.execute(delete(workers).where(workers.c.name.in_(some)))

    def add_asset_attempt(self, digest: str, number: int, *, not_before: float) -> None:
        values = {"last_attempt": number, "queued": False, "not_before": not_before}
        with self.database.write_transaction() as connection:
            earlier = (assets.c.digest == digest, assets.c.last_attempt < number)
            connection.execute(update(assets).where(*earlier).values(**values))
