"""Parts that go away in the middle of the work: tasks wait, say what for, and nothing is lost."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from graspd.service.index.rebuild import differences
from graspd.service.model.states import State
from tests.fakes import request
from tests.servers import PostgresServer, S3Server
from tests.system.conftest import System

pytestmark = pytest.mark.chaos
Start = Callable[..., System]


@pytest.fixture
def own_s3(s3_server: S3Server, monkeypatch: pytest.MonkeyPatch) -> Iterator[S3Server]:
    """An S3 server that the test may kill."""
    with S3Server() as server:
        for name, value in server.environment.items():
            monkeypatch.setenv(name, value)
        yield server


@pytest.fixture
def own_postgres(postgres_server: PostgresServer) -> Iterator[PostgresServer]:
    """A PostgreSQL that the test may kill."""
    with PostgresServer() as server:
        yield server


def messages(system: System, job: str) -> list[str]:
    return [task.message or "" for task in system.services.index.jobs.tasks(job=job, limit=200).items]


def finish_and_compare(system: System, job: str, grasps: int) -> None:
    (done,) = system.finish(job)
    assert (done.state, done.grasps) == (State.SUCCEEDED, grasps)
    assert system.services.index.jobs.attempts(job=job) == [], "it costs no attempt"
    system.until(lambda: not differences(system.services.index, system.services.store), "index and store agree")


@pytest.mark.s3
def test_a_store_killed_in_the_middle_is_waited_for(start: Start, own_s3: S3Server) -> None:
    system = start(workers=2, environment={"FAKE_SECONDS": "0.2"}, store_url=own_s3.url, retry_backoff_s=0.2)
    system.finish(system.submit(request(seed=1)))
    system.hold.touch()
    job = system.submit(request(grasps=32 * 20))
    system.until(lambda: system.services.index.jobs.get(job).state is State.RUNNING, "a task of it runs")
    own_s3.kill()
    system.hold.unlink()
    system.until(lambda: any(m.startswith("waits: the store") for m in messages(system, job)), "tasks say so")
    assert not system.services.index.jobs.get(job).state.is_final
    own_s3.start()
    finish_and_compare(system, job, 32 * 20)


@pytest.mark.postgres
def test_an_index_killed_in_the_middle_is_caught_up_with(start: Start, own_postgres: PostgresServer) -> None:
    system = start(index_url=own_postgres.database())
    system.finish(system.submit(request(seed=1)))
    system.hold.touch()
    job = system.submit(request(grasps=32 * 20))
    system.until(lambda: len(system.services.queue.waiting()) >= 4, "more waits than the one that runs")
    own_postgres.kill()
    made = len(list(system.services.store.list("shards")))
    system.hold.unlink()
    system.until(lambda: len(list(system.services.store.list("shards"))) > made + 4, "workers go on without it")
    own_postgres.start()
    finish_and_compare(system, job, 32 * 20)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 1 MB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(folder)]
    if os.getuid() != 0 or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("only root may mount a small file system")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


def test_a_full_disk_is_waited_for_until_there_is_room(start: Start, small_disk: Path) -> None:
    system = start(store_url=(small_disk / "store").as_uri(), retry_backoff_s=0.2)
    job = system.submit(request(grasps=32 * 100))
    says = "No space left on device"
    system.until(lambda: any(says in message for message in messages(system, job)), "a task says so")
    time.sleep(1.0)  # some more candidates
    assert not system.services.index.jobs.get(job).state.is_final
    subprocess.run(["mount", "-o", "remount,size=64m", str(small_disk)], check=True)
    finish_and_compare(system, job, 32 * 100)
