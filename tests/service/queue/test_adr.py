"""What RQ's defaults lose that are switched off: docs/adr has the decisions."""

import os
import re
import time
from collections.abc import Iterator
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from rq import Queue, Retry, SimpleWorker, Worker
from rq.command import send_stop_job_command
from rq.executions import Execution
from rq.job import Job
from rq.registry import BaseRegistry, ScheduledJobRegistry, StartedJobRegistry
from rq.serializers import JSONSerializer
from rq.timeouts import BaseDeathPenalty
from rq.worker import BaseWorker

from graspd.service.model.states import Priority, Stage, State
from graspd.service.pipeline import job_actions
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.indexer import Indexer
from graspd.service.pipeline.lease_reaper import LeaseReaper
from graspd.service.queue.entries import lease_registry_key, queue_name
from graspd.service.queue.rq_queue import RqQueue, cancel_key, rq_id
from tests.conftest import PACKAGES, REPOSITORY
from tests.fakes import request

NAME = queue_name(Priority.INTERACTIVE, Stage.SYNTHESIZE)
#: How long RQ's worker says that its lease lasts [s].
LEASE_S = 60


@pytest.fixture
def held(services: Services, rq_queue: RqQueue) -> tuple[Services, Job]:
    services = replace(services, queue=rq_queue)
    job, _ = job_actions.submit(services, request())
    (task,) = services.index.jobs.tasks(job=job.id).items
    assert Queue(NAME, connection=rq_queue.connection).pop_job_id() == rq_id(task.id, 1)
    taken = Job.fetch(rq_id(task.id, 1), connection=rq_queue.connection, serializer=JSONSerializer)
    with rq_queue.connection.pipeline() as pipe:
        Execution.create(taken, ttl=LEASE_S, pipeline=pipe)
        pipe.execute()
    return services, taken


def test_a_clock_that_is_ahead_takes_no_task_away(held: tuple[Services, Job], monkeypatch: pytest.MonkeyPatch) -> None:
    services, job = held
    registry = StartedJobRegistry(NAME, connection=services.queue.connection, serializer=JSONSerializer)  # type: ignore[attr-defined]
    now = [0.0]
    reaper = LeaseReaper(services, Indexer(services), clock=lambda: now[0])
    ahead = time.time() + 10 * LEASE_S
    monkeypatch.setattr(time, "time", lambda: ahead)
    for _ in range(50):
        now[0] += 1.0
        for entry, score in registry.connection.zrange(registry.key, 0, -1, withscores=True):
            registry.connection.zadd(registry.key, {entry: score + 1})  # a beat, by the worker's own clock
        assert reaper.reap(services.queue.leases()) == []
    assert not services.index.jobs.attempts()
    # RQ's own cleaning up, at that moment by that clock.
    registry.cleanup(timestamp=ahead)
    assert job.get_status() == "failed", "RQ calls it abandoned"
    assert not registry.connection.exists(lease_registry_key(NAME))


def test_a_command_that_nobody_hears_is_lost_and_a_key_is_not(held: tuple[Services, Job]) -> None:
    services, job = held
    connection = services.queue.connection  # type: ignore[attr-defined]
    job.worker_name = "w"
    job.save()
    connection.hset(job.key, "worker_name", "w")
    listener = connection.pubsub()
    send_stop_job_command(connection, job.id, serializer=JSONSerializer)
    listener.subscribe("rq:pubsub:w")  # the worker is connected again
    time.sleep(0.1)
    heard = [listener.get_message(timeout=0.1) for _ in range(3)]
    assert not any(message and message["type"] == "message" for message in heard)
    task = job.id.rpartition("-")[0]
    services.queue.discard([task])
    assert connection.exists(cancel_key(task)), "its next beat finds this"
    listener.close()


def _fail() -> None:
    raise RuntimeError("as a task does")


def test_retries_that_redis_counts_are_lost_with_it(held: tuple[Services, Job]) -> None:
    services, job = held
    connection = services.queue.connection  # type: ignore[attr-defined]
    plain = Queue("plain", connection=connection, serializer=JSONSerializer)
    failed = plain.enqueue(_fail, retry=Retry(max=1, interval=1))
    SimpleWorker([plain], connection=connection, serializer=JSONSerializer).work(burst=True, logging_level="CRITICAL")
    waits = ScheduledJobRegistry(queue=plain)
    assert (failed.get_status(), waits.get_job_ids()) == ("scheduled", [failed.id])
    now = [0.0]
    reaper = LeaseReaper(services, Indexer(services), clock=lambda: now[0])
    while not reaper.reap(services.queue.leases()):  # a worker that is silent
        now[0] += 1.0
    connection.flushdb()
    assert waits.get_job_ids() == [], "nobody knows of it"
    task = services.index.jobs.task(job.id.rpartition("-")[0])
    assert (task.attempt, task.state) == (2, State.QUEUED), "the second attempt is due"


LOADED: list[int] = []


def _load() -> int:
    LOADED.append(os.getpid())
    return len(LOADED)


def test_a_work_horse_loads_everything_anew_for_each_job(rq_queue: RqQueue) -> None:
    plain = Queue("plain", connection=rq_queue.connection, serializer=JSONSerializer)

    def loaded(worker: type[BaseWorker]) -> list[Any]:
        LOADED.clear()
        jobs = [plain.enqueue(_load) for _ in range(2)]
        work = worker([plain], connection=rq_queue.connection, serializer=JSONSerializer).work
        work(burst=True, logging_level="CRITICAL")
        return [job.return_value() for job in jobs]

    assert loaded(Worker) == [1, 1]
    assert loaded(SimpleWorker) == [1, 2]


#: What of RQ's worker is its own here, each a hook of RQ's: the order of the lists, what happens around a task, what is
#: passed over, what a signal stops, and that nobody commands.
OVERRIDDEN = {"dequeue_job_and_maintain_ttl", "execute_job", "handle_warm_shutdown_request"}
OVERRIDDEN |= {"reorder_queues", "subscribe"}


def test_rq_is_used_as_rq() -> None:
    """Members of RQ's classes that classes of the product redefine; names with two underscores do not count."""
    files = [file for package in PACKAGES for file in (REPOSITORY / package).rglob("*.py")]
    for file in files:
        if re.search(r"^(from|import) rq\b", file.read_text(), re.MULTILINE):
            import_module("graspd." + ".".join(file.relative_to(REPOSITORY).with_suffix("").parts))
    ours = {
        found
        for base in (BaseWorker, Job, Queue, BaseRegistry, Execution, BaseDeathPenalty)
        for found in _subclasses(base)
        if found.__module__.startswith("graspd.")
    }
    assert {
        name
        for found in ours
        for name in vars(found)
        if not name.startswith("__") and any(name in vars(base) for base in found.__mro__ if base not in ours)
    } == OVERRIDDEN


def _subclasses(base: type) -> Iterator[type]:
    for found in base.__subclasses__():
        yield found
        yield from _subclasses(found)


def test_every_decision_names_a_test_that_is_there() -> None:
    for page in sorted((REPOSITORY / "docs" / "adr").glob("0*.md")):
        named = re.findall(r"`(tests/[a-z_/]+\.py)(?:::(test_\w+))?`", page.read_text())
        assert named, f"{page.name} names no test"
        for file, test in named:
            assert f"def {test}" in Path(REPOSITORY / file).read_text(), (page.name, file, test)
