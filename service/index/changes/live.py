"""Changes of present state: waiting and running tasks, and workers. All are idempotent."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from sqlalchemy import Connection, delete, select, update

from graspd.service.index.changes.rows import NO_PROGRESS, derive_states, row_from, sanitize
from graspd.service.index.database import IndexPart, chunks, rows_in, update_rows, upsert
from graspd.service.index.tables import assets, jobs, tasks, workers
from graspd.service.model.states import State
from graspd.service.model.workers import WorkerBeat

_UNFINISHED = tasks.c.state.in_((State.QUEUED.value, State.RUNNING.value))


class Live(IndexPart):
    def set_running(self, workers: Mapping[str, str]) -> dict[str, State]:
        """Mark tasks as running; `workers` maps tasks to workers. Return the changed states of jobs."""
        running = State.RUNNING.value
        with self.database.writing() as connection:
            waiting = select(tasks.c.id, tasks.c.job_id).where(tasks.c.state == State.QUEUED.value)
            jobs_of = {row.id: row.job_id for row in rows_in(connection, waiting, tasks.c.id, workers)}
            started = {"state": running, "queued": True, "progress_done": 0.0, "progress_total": 0.0}
            rows = [{"id": task, **started, "worker": sanitize(workers[task], 128)} for task in jobs_of]
            update_rows(connection, tasks, rows, state=State.QUEUED.value)
            touched = sorted(set(jobs_of.values()))
            for some in chunks(touched):
                # A running job stays running: its other tasks need no check.
                of_waiting = update(jobs).where(jobs.c.id.in_(some), jobs.c.state == State.QUEUED.value)
                connection.execute(of_waiting.values(state=running))
            return dict.fromkeys(touched, State.RUNNING)

    def set_progress(self, progress: Mapping[str, tuple[float, float, str]]) -> None:
        rows = [
            {"id": task, "progress_done": done, "progress_total": total, "progress_message": sanitize(message)}
            for task, (done, total, message) in progress.items()
        ]
        with self.database.writing() as connection:
            update_rows(connection, tasks, rows, state=State.RUNNING.value)

    def set_queued(self, task_ids: Sequence[str]) -> None:
        with self.database.writing() as connection:
            for some in chunks(task_ids):
                connection.execute(update(tasks).where(tasks.c.id.in_(some), _UNFINISHED).values(queued=True))

    def set_waiting(
        self, task_ids: Sequence[str], *, not_before: float = 0.0, message: str | None = None
    ) -> dict[str, State]:
        """Mark tasks as neither queued nor running, not due before `not_before`; return the states of their jobs."""
        values = {"queued": False, "not_before": not_before, "state": State.QUEUED.value, "worker": None}
        values |= {**NO_PROGRESS, "progress_message": message and sanitize(message)}
        touched: set[str] = set()
        with self.database.writing() as connection:
            for some in chunks(task_ids):
                statement = update(tasks).where(tasks.c.id.in_(some), _UNFINISHED).values(**values)
                touched |= set(connection.scalars(statement.returning(tasks.c.job_id)))
            return {job: derive_states(connection, job, []) for job in touched}

    def set_asset_waiting(
        self, digests: Iterable[str], *, queued: bool, not_before: float = 0.0, message: str | None = None
    ) -> None:
        """Mark checks as not running, with the reason if known."""
        values: dict[str, Any] = {"queued": queued, "not_before": not_before}
        if message is not None:
            values["message"] = sanitize(message)
        with self.database.writing() as connection:
            connection.execute(update(assets).where(assets.c.digest.in_(list(digests))).values(**values))

    def set_workers(self, beats: Sequence[WorkerBeat], *, forget_before: str, lost_before: str = "9999") -> None:
        """Record living workers; mark missing ones as lost, and delete them after a while."""
        rows = [
            row_from(workers, beat, stages=[stage.value for stage in beat.stages], task_id=beat.task_id or None)
            for beat in beats
        ]
        with self.database.writing() as connection:
            upsert(connection, workers, rows)
            living = {beat.name for beat in beats}
            known = connection.execute(select(workers.c.name, workers.c.seen, workers.c.state)).all()
            gone = [row for row in known if row.name not in living]
            lost = [row.name for row in gone if row.seen < lost_before and row.state != "lost"]
            for some in chunks(lost):
                of_lost = update(workers).where(workers.c.name.in_(some))
                connection.execute(of_lost.values(state="lost", task_id=None, reason=""))
            self.forget_workers([row.name for row in gone if row.seen < forget_before], within=connection)

    def forget_workers(self, names: Sequence[str], *, within: Connection | None = None) -> None:
        with self.database.writing(within) as connection:
            for some in chunks(names):
                connection.execute(delete(workers).where(workers.c.name.in_(some)))

    def add_asset_attempt(self, digest: str, number: int, *, not_before: float) -> None:
        values = {"last_attempt": number, "queued": False, "not_before": not_before}
        with self.database.writing() as connection:
            earlier = (assets.c.digest == digest, assets.c.last_attempt < number)
            connection.execute(update(assets).where(*earlier).values(**values))
