"""Kills real processes and looks at what is left: every job ends, every result is there once, nothing stays behind."""

import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from graspd.service.index.queries.grasps import GraspFilter
from graspd.service.index.rebuild import differences
from graspd.service.model import names
from graspd.service.model.planning import plan_tasks
from graspd.service.model.states import Priority, Stage, State
from graspd.service.pipeline import job_actions
from graspd.service.pipeline.datasets import actions
from graspd.service.run.supervisor import Supervisor
from graspd.service.settings import Settings
from graspd.service.store.manifests import ShardManifest, load_shard
from graspd.service.store.records import read_record
from tests.fakes import record_of
from tests.fakes import request as wanted
from tests.service.conftest import is_up
from tests.service.pipeline.datasets.makers import add_asset, cells_of
from tests.service.pipeline.datasets.makers import wanted as wanted_dataset
from tests.system.conftest import System, alive
from tests.waiting import PATIENCE_S, until

pytestmark = pytest.mark.chaos
Start = Callable[..., System]
#: Promised time from the death of a worker to the next attempt of its task [s].
RECOVERY_S = 10.0


def running_on(system: System, job: str) -> str | None:
    """Name of the worker that runs the job's first unfinished task."""
    tasks = system.services.index.jobs.tasks(job=job, state=State.RUNNING).items
    return tasks[0].worker if tasks else None


def test_redis_killed_in_the_middle_comes_back_with_its_tasks(start: Start) -> None:
    system = start(workers=2, environment={"FAKE_SECONDS": "0.1"})
    system.hold.touch()
    jobs = [system.submit(wanted(grasps=96, scenes=1, seed=seed)) for seed in range(3)]
    system.until(lambda: any(running_on(system, job) for job in jobs), "the first task runs")
    system.kill("redis")
    system.hold.unlink()
    done = system.finish(*jobs)
    assert {job.state for job in done} == {State.SUCCEEDED}
    listed = [system.services.index.grasps.page(GraspFilter(job=job), limit=200).items for job in jobs]
    assert [len(grasps) for grasps in listed] == [96] * 3
    assert differences(system.services.index, system.services.store) == []


def test_a_worker_told_to_stop_hands_its_task_back_at_once(start: Start) -> None:
    system = start()
    system.hold.touch()
    job = system.submit(wanted(seed=3))
    system.until(lambda: running_on(system, job), "the task runs")
    first = running_on(system, job)
    os.kill(system.supervisor.pids["worker-0"], signal.SIGTERM)
    system.until(lambda: running_on(system, job) not in (None, first), "another worker runs it")
    system.hold.unlink()
    (done,) = system.finish(job)
    assert done.state is State.SUCCEEDED
    assert system.services.index.jobs.tasks(job=job).items[0].worker != first, "another worker ran it"
    assert system.services.index.jobs.attempts(job=job) == [], "nobody waited for the lease to run out"
    for name in ("controller", "worker-0", "redis"):
        pid = system.kill(name)
        system.until(lambda n=name, p=pid: system.supervisor.pids.get(n, p) != p, f"{name} is started again")
    system.supervisor.wait_ready(PATIENCE_S)
    (done,) = system.finish(system.submit(wanted(seed=5)))
    assert done.state is State.SUCCEEDED


_UP_IN_A_PROCESS = """
import json, sys, time
from pathlib import Path
from graspd.service.settings import Settings
from graspd.service.run.supervisor import Supervisor
up = Supervisor(Settings(data_dir=Path(sys.argv[1]), port=0, device="cpu"), api=False,
                worker_command=(sys.executable, "-m", "tests.fakes"))
up.start()
up.wait_ready(float(sys.argv[2]))
print(json.dumps(up.pids), flush=True)
time.sleep(600)
"""


def test_no_process_outlives_a_killed_supervisor(tmp_path: Path) -> None:
    command = [sys.executable, "-c", _UP_IN_A_PROCESS, str(tmp_path / "data"), str(PATIENCE_S)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as parent:
        assert parent.stdout is not None
        pids = json.loads(parent.stdout.readline())
        assert set(pids) == {"redis", "controller", "worker-0"}
        parent.kill()
    until(lambda: not any(alive(pid) for pid in pids.values()), "its children end with it")
    settings = Settings(data_dir=tmp_path / "data", port=0, device="cpu")
    with Supervisor(settings, api=False, worker_command=(sys.executable, "-m", "tests.fakes")) as again:
        again.wait_ready(PATIENCE_S)


@pytest.mark.parametrize(
    "remote",
    [pytest.param(False, marks=pytest.mark.slow), pytest.param(True, marks=[pytest.mark.s3, pytest.mark.postgres])],
)
@pytest.mark.parametrize(
    ("batches", "kills"),
    [
        pytest.param(80, 6, marks=pytest.mark.timeout(600)),
        pytest.param(2000, 60, marks=[pytest.mark.slow, pytest.mark.timeout(1800)]),
    ],
)
def test_random_kills_lose_nothing_and_repeat_nothing(
    start: Start, request: pytest.FixtureRequest, batches: int, kills: int, remote: bool
) -> None:
    """Redis, API, controller and workers are killed; with the store on S3 and the index in PostgreSQL too."""
    places: dict[str, str] = {}
    if remote:
        url = request.getfixturevalue("postgres_server").database()
        places = {"store_url": request.getfixturevalue("s3_url"), "index_url": url}
    quick = {"environment": {"FAKE_SECONDS": "0.05"}, "lease_s": 2.0, "retry_backoff_s": 0.1}
    system = start(workers=2, api=True, task_attempts=20, **quick, **places)
    rng = random.Random(0)
    jobs = [system.submit(wanted(grasps=32 * batches // 10, seed=seed)) for seed in range(10)]
    everyone: set[int] = set()
    killed: set[str] = set()
    for _ in range(kills):
        time.sleep(rng.uniform(0.2, 0.8))
        everyone |= set(system.supervisor.pids.values())
        # Those not killed yet come first, so that every part is killed at least once.
        names_now = sorted(system.supervisor.pids)
        name = rng.choice(sorted(set(names_now) - killed) or names_now or ["controller"])
        if name in system.supervisor.pids:
            system.kill(name)
            killed.add(name)
    assert killed >= {"redis", "api", "controller", "worker-0"}
    done = system.finish(*jobs, seconds=PATIENCE_S + batches)
    assert {job.state for job in done} == {State.SUCCEEDED}
    manifests = [e.key for e in system.services.store.list(names.SHARDS) if e.key.endswith(".json")]
    assert len(manifests) == batches
    assert system.services.index.overview.stats().grasps == 32 * batches
    system.until(lambda: not differences(system.services.index, system.services.store), "index and store agree")
    system.supervisor.stop()
    assert not [pid for pid in everyone if alive(pid)]


def submitted(system: System, grasps: int, *, span: int) -> str:
    """A job in bulk whose tasks have so many batches."""
    record = job_actions.prepare_job(system.services, wanted(grasps=grasps), priority=Priority.BULK)
    return job_actions.enter_job(system.services, record.model_copy(update={"span": span}))[0].id


def test_the_range_of_a_killed_worker_is_made_again_once(start: Start) -> None:
    system = start(lease_s=2.0)
    system.hold.touch()
    job = submitted(system, 32 * 5, span=3)
    running = system.services.index.jobs.tasks
    system.until(lambda: len(running(job=job, state=State.RUNNING).items) == 1, "the worker holds a range")
    killed = system.kill("worker-0")
    system.until(lambda: not alive(killed), "it is dead")
    system.hold.unlink()
    system.until(lambda: system.services.index.jobs.attempts(job=job), "the worker is found lost")
    (done,) = system.finish(job)
    assert (done.state, done.grasps) == (State.SUCCEEDED, 160)
    (attempt,) = system.services.index.jobs.attempts(job=job)
    assert attempt.kind == "WorkerLost" and f"-{killed}-" in attempt.worker
    assert "no heartbeat for 2 s" in attempt.reason
    usual = Settings()
    assert usual.lease_s + usual.controller_interval_s + usual.retry_backoff_s < RECOVERY_S
    assert differences(system.services.index, system.services.store) == []
    record = record_of(system.services, job)
    made = [load_shard(system.services.store, Stage.SYNTHESIZE, task.output) for task in plan_tasks(record)]
    parts = {shard.attributes["batch"]: shard.attributes["batch_rows"] for shard in made}
    assert parts == {0: "[32, 32, 32]", 3: "[32, 32]"} and len(made) == 2
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


OBJECTS = tuple(f"object-{i}" for i in range(20))


def made(system: System) -> dict[str, str]:
    store = system.services.store
    keys = [entry.key for entry in store.list(names.SHARDS) if entry.key.endswith(".json")]
    return {key: read_record(ShardManifest, store, key).created for key in keys}


def test_a_dataset_goes_on_after_everything_was_killed(start: Start) -> None:
    system = start(environment={"FAKE_SECONDS": "0.1"}, lease_s=2.0, retry_backoff_s=0.1)
    for name in OBJECTS:
        add_asset(system.services, "object", name)
    request = wanted_dataset("kitchen", hands=("gripper",), objects=OBJECTS, scenes=1)
    actions.create(system.services, request)
    kitchen = lambda: system.services.index.datasets.get("kitchen")  # noqa: E731
    system.until(lambda: kitchen().states[State.SUCCEEDED] >= 5, "a quarter is done")
    system.hold.touch()
    for pid in system.supervisor.pids.values():
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    before = made(system)
    assert len(before) < 2 * len(OBJECTS)
    system.until(lambda: is_up(system.services.queue), "Redis is started again")
    again, new = actions.create(system.services, request)
    assert not new and not again.state.is_final
    system.hold.unlink()
    system.until(lambda: kitchen().state.is_final, "the dataset is done")
    after = made(system)
    assert {key: after[key] for key in before} == before
    assert len(after) == 2 * len(OBJECTS)
    assert {cell.state for cell in cells_of(system.services, "kitchen")} == {State.SUCCEEDED}
    assert differences(system.services.index, system.services.store) == []
    taken, _ = actions.take_snapshot(system.services, "kitchen")
    assert taken.complete and len(taken.shards) == len(after)
