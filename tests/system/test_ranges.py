"""A worker that holds a task of several batches is killed: the range is made again, and nothing else is lost."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from graspd.service.model.planning import plan
from graspd.service.model.states import Priority, Stage, State
from graspd.service.pipeline import job_actions
from graspd.service.store.manifests import load_shard
from tests.fakes import record_of
from tests.fakes import request as wanted
from tests.system.conftest import System, alive

pytestmark = pytest.mark.chaos
Start = Callable[..., System]


def submitted(system: System, grasps: int, *, span: int) -> str:
    """A job in bulk whose tasks have so many batches."""
    record = job_actions.prepare(system.services, wanted(grasps=grasps), priority=Priority.BULK)
    return job_actions.enter(system.services, record.model_copy(update={"span": span}))[0].id


def test_the_range_of_a_killed_worker_is_made_again_once(start: Start) -> None:
    system = start(lease_s=2.0)
    system.hold.touch()
    job = submitted(system, 32 * 5, span=3)
    running = system.services.index.jobs.tasks
    system.until(lambda: len(running(job=job, state=State.RUNNING).items) == 1, "the worker holds a range")
    killed = system.kill("worker-0")
    system.until(lambda: not alive(killed), "it is dead")
    system.hold.unlink()
    (done,) = system.finish(job)
    assert (done.state, done.grasps) == (State.SUCCEEDED, 160)
    (attempt,) = system.services.index.jobs.attempts(job=job)
    assert attempt.kind == "WorkerLost" and f"-{killed}-" in attempt.worker
    record = record_of(system.services, job)
    made = [load_shard(system.services.store, Stage.SYNTHESIZE, task.output) for task in plan(record)]
    assert [(shard.attributes["batch"], shard.attributes["batch_rows"]) for shard in made] == [
        (0, "[32, 32, 32]"),
        (3, "[32, 32]"),
    ]
    rows = np.concatenate([shard["grasp/joint_positions"] for shard in made])
    assert len(np.unique(rows, axis=0)) == 160, "no batch is there twice"


def test_a_worker_killed_before_its_event_has_its_task_done(start: Start, tmp_path: Path) -> None:
    killed = tmp_path / "killed"
    system = start(environment={"FAKE_DIE_UNTOLD": str(killed)})
    job = submitted(system, 96, span=3)
    (done,) = system.finish(job)
    assert (done.state, done.grasps) == (State.SUCCEEDED, 96)
    keys = sorted(entry.key for entry in system.services.store.list("shards"))
    assert keys == [f"shards/base/{killed.read_text()}.{ending}" for ending in ("h5", "json")]
    assert not system.services.index.jobs.attempts(job=job), "no attempt was used up"


@pytest.mark.slow
def test_a_range_that_kills_its_worker_takes_no_other_one_down(start: Start) -> None:
    system = start(environment={"FAKE_POISON": "2", "FAKE_SECONDS": "0.2"}, lease_s=2.0, retry_backoff_s=0.1)
    job = submitted(system, 32 * 6, span=2)
    (done,) = system.finish(job)
    assert done.state is State.FAILED
    tasks = sorted(system.services.index.jobs.tasks(job=job).items, key=lambda task: task.batch)
    assert [(task.batch, task.state) for task in tasks] == [
        (0, State.SUCCEEDED),
        (2, State.FAILED),
        (4, State.SUCCEEDED),
    ]
    assert [attempt.task_id for attempt in system.services.index.jobs.attempts(job=job)] == [tasks[1].id] * 3
