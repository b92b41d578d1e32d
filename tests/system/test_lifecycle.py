"""Workers that come and go as they should, and whose turn it is."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable

import pytest

from graspd.service.model.clock import timestamp
from graspd.service.model.states import Priority, State
from graspd.service.pipeline import job_actions
from tests.fakes import request
from tests.system.conftest import System

pytestmark = pytest.mark.chaos
Start = Callable[..., System]

#: Batches of a dataset that wait in the queue before a later small job.
_WAITING = 500
#: Of these may be done before it: those that run, every fourth turn, and what one worker does while the other has it.
_BEFORE_IT = 150


def makers(system: System) -> set[str]:
    """Names of the workers that made a shard."""
    return {shard.worker for shard in system.services.index.shards.page(limit=200).items}


def test_a_worker_that_leaks_makes_room_before_it_holds_too_much(start: Start) -> None:
    system = start(environment={"FAKE_LEAK_MB": "200"}, worker_max_memory_mb=450)
    (done,) = system.finish(system.submit(request(grasps=32 * 6)))
    assert done.state is State.SUCCEEDED
    assert len(makers(system)) >= 3, "the second task is one too many for each"
    assert system.services.index.jobs.attempts() == []
    assert "lost" not in {worker.state for worker in system.services.index.overview.workers()}


def test_a_worker_that_was_stopped_is_not_shown_as_lost(start: Start) -> None:
    system = start()
    system.until(system.services.index.overview.workers, "the worker is listed")
    (first,) = system.services.index.overview.workers()
    seen: set[str] = set()

    def is_gone() -> bool:
        now = system.services.index.overview.workers()
        seen.update(worker.state for worker in now)
        return first.name not in {worker.name for worker in now}

    os.kill(system.supervisor.pids["worker-0"], signal.SIGTERM)
    system.until(is_gone, "it is no longer listed")
    assert "lost" not in seen


def test_a_worker_that_was_killed_is_shown_as_lost(start: Start) -> None:
    system = start(lease_s=2.0)
    system.until(system.services.index.overview.workers, "the worker is listed")
    system.kill("worker-0")
    states = lambda: {worker.state for worker in system.services.index.overview.workers()}  # noqa: E731
    system.until(lambda: "lost" in states(), "it is lost")


def test_somebody_at_a_screen_does_not_wait_for_a_dataset(start: Start) -> None:
    system = start(workers=2, environment={"FAKE_SECONDS": "0.3"})
    bulk = job_actions.submit(system.services, request(grasps=100_000), priority=Priority.BULK)[0].id
    system.until(lambda: system.services.index.jobs.get(bulk).grasps, "the dataset runs")
    system.hold.touch()
    system.until(lambda: len(system.services.queue.waiting()) >= _WAITING, "the dataset fills the queue")
    job = system.submit(request(grasps=32, seed=1))
    (task,) = system.services.index.jobs.tasks(job=job).items
    system.until(lambda: task.id in system.services.queue.waiting(), "the small job waits too")
    released = timestamp()
    system.hold.unlink()
    (done,) = system.finish(job)
    assert system.services.index.jobs.get(bulk).state is State.RUNNING
    batches = system.services.index.jobs.tasks(job=bulk, state=State.SUCCEEDED, limit=200).items
    between = [task for task in batches if released < (task.finished or "") < (done.finished or "")]
    assert len(between) <= _BEFORE_IT, f"of {_WAITING} batches that waited before it, {len(between)} went first"


def test_steady_small_jobs_do_not_stop_a_dataset(start: Start) -> None:
    system = start(environment={"FAKE_SECONDS": "0.05"})
    bulk = job_actions.submit(system.services, request(grasps=3200), priority=Priority.BULK)[0].id
    ended = threading.Event()

    def keep_busy() -> None:
        seed = 0
        while not ended.is_set():
            # There are always more small tasks than the one worker gets done.
            if (
                sum(
                    n for (priority, _), n in system.services.queue.depths().items() if priority is Priority.INTERACTIVE
                )
                < 8
            ):
                seed += 1
                system.submit(request(grasps=128, seed=seed))
            time.sleep(0.02)

    thread = threading.Thread(target=keep_busy)
    thread.start()
    try:
        system.until(
            lambda: system.services.index.jobs.get(bulk).grasps >= 5 * 32, "five batches of the dataset are done"
        )
    finally:
        ended.set()
        thread.join()
