"""Conversion of store records to rows; derivation of the states of tasks and jobs."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import groupby
from typing import Any, Final

from sqlalchemy import ColumnElement, Connection, Table, exists, func, literal, select, tuple_, update

from graspd.service.index.database import chunks
from graspd.service.index.outbox import append_ends
from graspd.service.index.tables import attempts, jobs, notes, shards, tasks
from graspd.service.model.domain import Asset, JobOptions
from graspd.service.model.errors import LoadError, SceneError
from graspd.service.model.planning import TaskFacts, batch_ready, batch_states, job_state, plan, stages_of
from graspd.service.model.records import JobRecord
from graspd.service.model.states import State
from graspd.service.store.manifests import ShardManifest

Row = dict[str, Any]
#: Limits for facts [bytes], repairs and texts of a hand or object: lists contain them, and uploads are untrusted.
_MOST_FACTS: Final = 64 << 10
_MOST_REPAIRS: Final = 100
_LONGEST_TEXT: Final = 2000


def job_row(record: JobRecord) -> Row:
    plain = ("id", "hand_digest", "object_digest", "owner", "project", "span", "created")
    return {
        **{name: getattr(record, name) for name in plain},
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


def neighbour_digests(options: JobOptions) -> str:
    return " ".join(dict.fromkeys(one.digest or "" for one in options.beside))


NO_PROGRESS: Final = {"progress_done": 0.0, "progress_total": 0.0, "progress_message": None}
_UNSTARTED: Final = {
    "state": State.QUEUED.value,
    **dict.fromkeys(("ready", "done", "exhausted", "queued"), False),
    **dict.fromkeys(("last_attempt", "retried_upto"), 0),
    **dict.fromkeys(("reason", "worker", "device", "seconds", "finished")),
    "not_before": 0.0,
    **NO_PROGRESS,
}


def task_rows(record: JobRecord, ranges: range | None = None) -> Iterator[Row]:
    order = stages_of(record.request)
    for task in plan(record, ranges):
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
    """Return text that all databases accept: PostgreSQL rejects code zero and limits lengths."""
    return text.replace("\0", "")[:length]


def row_from(table: Table, record: object, **others: Any) -> Row:
    """Return a row with a record's attributes; `others` replace some, and text is cut to column length."""
    row = {column.name: getattr(record, column.name) for column in table.columns if column.name not in others} | others
    lengths = {column.name: getattr(column.type, "length", None) for column in table.columns}
    return {name: sanitize(value, lengths[name]) if isinstance(value, str) else value for name, value in row.items()}


def shard_row(manifest: ShardManifest) -> Row:
    plain = [column.name for column in shards.columns if column.name not in ("id", "charged", "manifest")]
    return {
        **{name: getattr(manifest, name) for name in plain},
        "id": manifest.shard_id,
        "stage": manifest.stage.value,
        "inputs": list(manifest.inputs),
        "manifest": manifest.model_dump(mode="json", exclude={"grasps"}),
    }


def grasp_rows(manifest: ShardManifest) -> list[Row]:
    of_shard = {
        "shard_id": manifest.shard_id,
        "hand": manifest.hand,
        "object": manifest.object,
        "scene_kind": manifest.request.place.kind,
        "neighbours": len(manifest.request.beside),
        "created": manifest.created,
    }
    return [of_shard | {"row": row} | grasp.model_dump() for row, grasp in enumerate(manifest.grasps)]


def asset_row(asset: Asset, check: Mapping[str, Any] | None) -> Row:
    """Return the row of a hand, object or network. Built-in assets need no check."""
    found = check or ({"verdict": "accept"} if asset.builtin else {})
    plain = ("digest", "name", "filename", "size_bytes", "created", "builtin", "owner", "project", "shared")
    return {
        **{name: getattr(asset, name) for name in plain},
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


def _limited_facts(facts: dict[str, Any]) -> dict[str, Any]:
    """Return all facts, or only numbers if the facts are too long; `check.json` has the rest."""
    if len(json.dumps(facts)) <= _MOST_FACTS:
        return facts
    return {name[:100]: value for name, value in list(facts.items())[:100] if isinstance(value, int | float)}


#: Jobs whose states are derived together.
_JOBS_AT_ONCE: Final = 200
_FACTS: Final = ("stage", "done", "last_attempt", "exhausted", "retried_upto")

#: Option of a connection that suppresses reports of ended jobs and datasets.
QUIET: Final = "graspd_quiet"
#: Prefix of the note about a job with tasks still to enter; the job's id follows.
ENTERING: Final = "entering "
_WHOSE: Final = (jobs.c.project, jobs.c.owner)


def derive_states(connection: Connection, job_id: str, batches: Collection[int] | None = None) -> State:
    """Derive the states of a job's tasks, in all or some batches, and of the job; return the job's state."""
    return derive_batch_states(connection, {job_id: batches})[job_id]


def derive_batch_states(connection: Connection, touched: Mapping[str, Collection[int] | None]) -> dict[str, State]:
    """Derive the states of tasks in some batches (None: all) and of their jobs; return the jobs' states.

    If a job's first batch fails because of its scenes or the object's weight, the other batches are cancelled.
    """
    states: dict[str, State] = {}
    for some in chunks(list(touched), _JOBS_AT_ONCE):
        _derive_task_states(connection, {job: touched[job] for job in some})
        states |= _derive_job_states(connection, some)
    return states


def _derive_task_states(connection: Connection, touched: Mapping[str, Collection[int] | None]) -> None:
    query = select(jobs.c.id, jobs.c.cancelled, _first_batch_failed()).where(jobs.c.id.in_(list(touched)))
    facts = {row.id: row for row in connection.execute(query)}
    cancelled = {job for job, row in facts.items() if row.cancelled or row.hopeless}
    whole = [job for job, batches in touched.items() if batches is None or (job in facts and facts[job].hopeless)]
    pairs = [
        (job, batch) for job, batches in touched.items() if job not in whole for batch in sorted(set(batches or ()))
    ]
    rows: list[Any] = []
    for wanted in (
        *(tasks.c.job_id.in_(some) for some in chunks(whole)),
        *(tuple_(tasks.c.job_id, tasks.c.batch).in_(some) for some in chunks(pairs)),
    ):
        query = select(*(tasks.c[name] for name in ("job_id", "id", "batch", "state", "ready", *_FACTS)))
        query = query.where(wanted).order_by(tasks.c.job_id, tasks.c.batch, tasks.c.position)
        rows += connection.execute(query).mappings()
    changes: defaultdict[tuple[str, bool], list[str]] = defaultdict(list)
    for (job, _), chain in groupby(rows, key=lambda row: (row["job_id"], row["batch"])):
        for task, state, ready in _changes(list(chain), cancelled=job in cancelled):
            changes[state, ready].append(task)
    for (state, ready), ids in changes.items():
        for some in chunks(ids):
            connection.execute(update(tasks).where(tasks.c.id.in_(some)).values(state=state, ready=ready))


def _first_batch_failed() -> ColumnElement[bool]:
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


def _changes(chain: Sequence[Any], *, cancelled: bool) -> list[tuple[str, str, bool]]:
    """Return the changed tasks of a batch, each with its new state and readiness."""
    facts = [TaskFacts(running=row["state"] == State.RUNNING, **{name: row[name] for name in _FACTS}) for row in chain]
    states = batch_states(facts, job_cancelled=cancelled)
    return [
        (row["id"], state.value, ready)
        for row, state, ready in zip(chain, states, batch_ready(states), strict=True)
        if (row["state"], row["ready"]) != (state.value, ready)
    ]


def _derive_job_states(connection: Connection, ids: Sequence[str]) -> dict[str, State]:
    # Six index look-ups; a query of distinct states would read every task of the job.
    of_job = tasks.c.job_id == jobs.c.id
    probes = [exists().where(of_job, tasks.c.state == state.value).label(state.value) for state in State]
    probes.append(exists().where(notes.c.name == literal(ENTERING) + jobs.c.id).label("entering"))
    query = select(jobs.c.id, jobs.c.state.label("now"), jobs.c.finished, jobs.c.reason, *_WHOSE, *probes)
    known = {row["id"]: row for row in connection.execute(query.where(jobs.c.id.in_(ids))).mappings()}
    states: dict[str, State] = {}
    ended: list[dict[str, Any]] = []
    for job in ids:
        row = known.get(job)
        found = [state for state in State if row is not None and row[state.value]]
        found += [State.QUEUED] if row is not None and row["entering"] else []
        state = states[job] = job_state(found)
        if row is None:
            continue
        values: dict[str, Any] = {"state": state.value, "finished": None, "reason": None}
        if state.is_final:
            values["finished"] = connection.scalar(select(func.max(tasks.c.finished)).where(tasks.c.job_id == job))
        if State.FAILED in found:
            first = select(tasks.c.reason).where(tasks.c.job_id == job, tasks.c.state == State.FAILED.value)
            values["reason"] = connection.scalar(first.order_by(tasks.c.batch, tasks.c.position).limit(1))
        # Most jobs are unchanged; their rows are not written.
        if values != {"state": row["now"], "finished": row["finished"], "reason": row["reason"]}:
            connection.execute(update(jobs).where(jobs.c.id == job).values(**values))
            if state.is_final and state != row["now"]:
                about = {"kind": "job", "subject": job, "state": state.value}
                ended.append(about | {"project": row["project"], "owner": row["owner"]})
    # A rebuild reports no past ends of jobs and datasets.
    if not connection.get_execution_options().get(QUIET):
        append_ends(connection, ended)
    return states
