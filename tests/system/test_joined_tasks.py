"""A worker that holds several tasks at once is killed: every one of them comes back, and none takes others down."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from service.model.states import State
from tests.fakes import request as wanted
from tests.system.conftest import System, alive

pytestmark = pytest.mark.chaos
Start = Callable[..., System]


def test_every_task_of_a_killed_worker_runs_again_and_its_result_appears_once(start: Start) -> None:
    system = start(join="4", lease_s=2.0)
    system.hold.touch()
    job = system.submit(wanted(grasps=96))
    running = system.parts.index.jobs.tasks
    system.until(lambda: len(running(job=job, state=State.RUNNING).items) == 3, "one worker holds three tasks")
    killed = system.kill("worker-0")
    system.until(lambda: not alive(killed), "it is dead")
    system.hold.unlink()
    (done,) = system.finish(job)
    assert (done.state, done.grasps) == (State.SUCCEEDED, 96)
    attempts = system.parts.index.jobs.attempts(job=job)
    assert sorted(attempt.kind for attempt in attempts) == ["WorkerLost"] * 3
    assert len({attempt.task_id for attempt in attempts}) == 3
    assert all(f"-{killed}-" in attempt.worker for attempt in attempts)


def test_a_worker_killed_between_pack_and_event_has_its_tasks_done_all_the_same(start: Start, tmp_path: Path) -> None:
    killed = tmp_path / "killed"
    system = start(environment={"FAKE_PACKED": str(killed)}, join="4", shard_pack=3)
    job = system.submit(wanted(grasps=96))
    (done,) = system.finish(job)
    assert (done.state, done.grasps) == (State.SUCCEEDED, 96)
    assert [entry.key for entry in system.parts.store.list("packs")] == [killed.read_text()]
    assert list(system.parts.store.list("shards")) == [], "nothing was made twice"
    assert not system.parts.index.jobs.attempts(job=job), "no attempt was used up"


@pytest.mark.slow
def test_a_task_that_kills_its_worker_takes_no_other_one_down(start: Start) -> None:
    system = start(environment={"FAKE_POISON": "1", "FAKE_SECONDS": "0.2"}, join="4", lease_s=2.0, retry_backoff_s=0.1)
    job = system.submit(wanted(grasps=96))
    (done,) = system.finish(job)
    assert done.state is State.FAILED
    tasks = system.parts.index.jobs.tasks(job=job).items
    assert [task.state for task in sorted(tasks, key=lambda task: task.batch)] == [
        State.SUCCEEDED, State.FAILED, State.SUCCEEDED,
    ]  # fmt: skip
    lost = [attempt.task_id for attempt in system.parts.index.jobs.attempts(job=job)]
    poison = next(task.id for task in tasks if task.state is State.FAILED)
    assert lost.count(poison) == 3
    assert all(lost.count(task.id) <= 1 for task in tasks if task.id != poison), "tried again, each is by itself"
