"""Keeps the states of tasks and jobs in step with the facts about them, inside one transaction."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from itertools import groupby
from typing import Any

from sqlalchemy import ColumnElement, Connection, bindparam, exists, func, select, update

from service.index.tables import attempts, jobs, tasks
from service.model.domain import State
from service.model.errors import SceneError
from service.model.planning import TaskFacts, batch_ready, batch_states, job_state

_FACTS = (
    tasks.c.id,
    tasks.c.batch,
    tasks.c.stage,
    tasks.c.state,
    tasks.c.ready,
    tasks.c.done,
    tasks.c.last_attempt,
    tasks.c.exhausted,
    tasks.c.retried_upto,
)


def settle(connection: Connection, job_id: str, batches: Collection[int] | None = None) -> State:
    """Derive the states of a job's tasks, of some batches or all, then the job's own.

    Where the first batch found no grasp in its scenes, the job's other batches are not made: they end as if cancelled.

    Returns:
        the job's state.
    """
    facts = connection.execute(select(jobs.c.cancelled, _hopeless(job_id)).where(jobs.c.id == job_id)).first()
    cancelled = facts is not None and any(facts)
    if facts is not None and facts.hopeless:
        batches = None
    query = select(*_FACTS).where(tasks.c.job_id == job_id).order_by(tasks.c.batch, tasks.c.position)
    if batches is not None:
        query = query.where(tasks.c.batch.in_(sorted(set(batches))))
    changes = []
    for _, chain in groupby(connection.execute(query).mappings().all(), key=lambda row: row["batch"]):
        changes += _changes(list(chain), cancelled=cancelled)
    if changes:
        statement = (
            update(tasks)
            .where(tasks.c.id == bindparam("task"))
            .values(state=bindparam("new_state"), ready=bindparam("new_ready"))
        )
        connection.execute(statement, changes)
    return _settle_job(connection, job_id)


def _hopeless(job_id: str) -> ColumnElement[bool]:
    """Whether the first batch of a job ended because of its scenes."""
    last = (attempts.c.task_id == tasks.c.id) & (attempts.c.number == tasks.c.last_attempt)
    failed = (tasks.c.done.is_(False), tasks.c.exhausted.is_(True), tasks.c.last_attempt > tasks.c.retried_upto)
    return (
        exists()
        .select_from(tasks)
        .where(tasks.c.job_id == job_id, tasks.c.batch == 0, *failed, last, attempts.c.kind == SceneError.__name__)
        .label("hopeless")
    )


def _changes(chain: Sequence[Any], *, cancelled: bool) -> list[dict[str, Any]]:
    facts = [
        TaskFacts(
            stage=row["stage"],
            done=row["done"],
            last_attempt=row["last_attempt"],
            exhausted=row["exhausted"],
            retried_upto=row["retried_upto"],
            running=row["state"] == State.RUNNING,
        )
        for row in chain
    ]
    states = batch_states(facts, job_cancelled=cancelled)
    return [
        {"task": row["id"], "new_state": state.value, "new_ready": ready}
        for row, state, ready in zip(chain, states, batch_ready(states), strict=True)
        if (row["state"], row["ready"]) != (state.value, ready)
    ]


def _settle_job(connection: Connection, job_id: str) -> State:
    of_job = tasks.c.job_id == job_id
    # Five probes of an index; to collect the distinct states would read every task of the job.
    probes = [exists().where(of_job, tasks.c.state == state.value).label(state.value) for state in State]
    found = connection.execute(select(*probes)).mappings().one()
    states = [state for state in State if found[state.value]]
    state = job_state(states)
    values: dict[str, Any] = {"state": state.value, "finished": None, "reason": None}
    if state.is_final:
        values["finished"] = connection.scalar(select(func.max(tasks.c.finished)).where(of_job))
    if State.FAILED in states:
        first = select(tasks.c.reason).where(of_job, tasks.c.state == State.FAILED.value)
        values["reason"] = connection.scalar(first.order_by(tasks.c.batch, tasks.c.position).limit(1))
    connection.execute(update(jobs).where(jobs.c.id == job_id).values(**values))
    return state
