"""Whoever writes to Redis can forge entries and jobs: nothing of theirs runs, feeding and reaping go on, pages show."""

import contextlib
import json
import os
import zlib
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
from rq import Callback, Queue, Retry
from rq.job import Job
from rq.serializers import DefaultSerializer, JSONSerializer

from graspd.api.metrics import Metrics, MetricsSnapshot
from graspd.service.model.clock import timestamp
from graspd.service.model.errors import TaskRefused, UnavailableError
from graspd.service.model.states import Stage, State
from graspd.service.pipeline import job_actions
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.controller import Controller
from graspd.service.pipeline.leading import PART
from graspd.service.queue.entries import TASK_FUNCTION, sanitized_job
from graspd.service.queue.port import Event, EventKind
from graspd.service.queue.rq_queue import EVENTS, METRICS, WORKERS, RqQueue, worker_key
from tests.fakes import beat_of, request
from tests.service.conftest import service

WIP = "rq:wip:interactive-synthesize"
WAITING = "rq:queue:interactive-synthesize"
BEAT = asdict(beat_of(pid=2**70))
EVENT = {"kind": EventKind.FINISHED.value, "at": timestamp(), "stage": "synthesize", "task_id": "t"}


def _message(**facts: object) -> bytes:
    told = {"schema": 1, "stage": "synthesize", **facts}
    return zlib.compress(json.dumps(["graspd.task", None, [told], {}]).encode())


def _beat(redis: Any, name: bytes, **facts: object) -> None:
    redis.sadd(WORKERS, name)
    redis.set(b"graspd:worker:" + name, json.dumps({**BEAT, **facts}))


def _event(redis: Any, **facts: object) -> None:
    redis.xadd(EVENTS, {"e": json.dumps({**EVENT, **facts})})


FORGERIES: dict[str, Callable[[Any], object]] = {
    "a worker whose name is no text": lambda redis: redis.sadd(WORKERS, b"\xff"),
    "a worker with a huge number": lambda redis: _beat(redis, b"w"),
    "a worker with half a letter": lambda redis: _beat(redis, b"w", pid=1, device="\ud800"),
    "a worker whose time is a book": lambda redis: _beat(redis, b"w", pid=1, seen="9" * 5000),
    "a list at a worker's key": lambda redis: (redis.sadd(WORKERS, "l"), redis.rpush(worker_key("l"), "x")),
    "a lease with blanks": lambda redis: redis.zadd(WIP, {"x y z": 1}),
    "a lease that is no text": lambda redis: redis.zadd(WIP, {b"\xff\xfe:\xfd": 1}),
    "a lease with an attempt of 5,000 digits": lambda redis: redis.zadd(WIP, {"a-" + "9" * 5000: 1}),
    "a string at a leased job's key": lambda redis: (redis.zadd(WIP, {"X:1": 1}), redis.set("rq:job:X", "x")),
    "a string at a lease's key": lambda redis: (redis.zadd(WIP, {"X:1": 1}), redis.set("rq:execution:X:1", "x")),
    "a lease of a task that leaves the store": lambda redis: (
        redis.zadd(WIP, {"X:1": 1}),
        redis.hset("rq:job:X", "data", _message(task_id="../x", job_id="", output="../../x")),
    ),
    "a waiting task that is no text": lambda redis: redis.rpush(WAITING, b"\xff"),
    "a waiting task with an attempt of 5,000 digits": lambda redis: redis.rpush(WAITING, "a-" + "9" * 5000),
    "a string at a waiting job's key": lambda redis: (redis.rpush(WAITING, "X"), redis.set("rq:job:X", "x")),
    "an event that names a file's file": lambda redis: _event(redis, output="x.json/y"),
    "an event with a name of 5,000 letters": lambda redis: _event(redis, output="x" * 5000),
    "an event without end": lambda redis: redis.xadd(EVENTS, {"e": b"[" * 100_000}),
    "a stream that is shut": lambda redis: redis.xadd(EVENTS, {"e": "x"}, id=f"{2**64 - 1}-{2**64 - 1}"),
    "a sum that is no number": lambda redis: redis.hset(METRICS, b"\xff", b"much"),
    **{
        f"a string at {name}": lambda redis, name=name: (redis.delete(name), redis.set(name, "x"))  # type: ignore[misc]
        for name in (EVENTS, WORKERS, METRICS, WIP, WAITING)
    },
}


@pytest.fixture
def services(tmp_path: Path, rq_queue: RqQueue) -> Iterator[Services]:
    yield from service(tmp_path, queue=rq_queue)


@pytest.mark.parametrize("what", FORGERIES)
def test_a_forged_entry_stops_nothing(services: Services, what: str) -> None:
    now = [1000.0]
    controller = Controller(services, clock=lambda: now[0])
    queue: Any = services.queue
    controller.run_round()
    queue.connection.zadd(WIP, {"b" * 32 + "-1:execution": 1})  # of a worker that died
    FORGERIES[what](queue.connection)
    for _ in range(8):
        now[0] += 2.0
        with contextlib.suppress(UnavailableError):  # a round may find a part out of order; it puts that right
            controller.run_round()
    controller.run_round()
    job, _ = job_actions.submit(services, request())
    (task,) = services.index.jobs.tasks(job=job.id).items
    assert task.id in queue.waiting_tasks(), "feeding goes on"
    assert queue.leases() == [], "what nobody holds is taken off"
    queue.publish(Event(kind=EventKind.STARTED, at=timestamp(), task_id=task.id, stage=Stage.SYNTHESIZE))
    controller.run_round()
    assert services.index.jobs.get(job.id).state is State.RUNNING, "events are read"
    queue.discard([task.id])
    assert task.id not in queue.waiting_tasks()
    page = MetricsSnapshot()
    page.add_queue(queue.status(lease_s=6), is_kept=queue.is_announced(PART))
    page.add_sums(queue.counter_sums())
    assert b"graspd_workers" in Metrics().render(page)
    assert [beat.name for beat in queue.workers()] == []


def forge(queue: RqQueue, function: str, *args: Any, serializer: Any = JSONSerializer, **options: Any) -> str:
    plain = Queue("bulk-synthesize", connection=queue.connection, serializer=serializer)
    job: str = plain.enqueue_call(function, args=args, **options).id
    return job


def fetch(queue: RqQueue, job: str) -> Job:
    bulk = Queue("bulk-synthesize", connection=queue.connection, serializer=JSONSerializer)
    return sanitized_job(Job.fetch(job, connection=queue.connection, serializer=JSONSerializer), bulk)


@pytest.mark.parametrize(
    "function", ["os.system", "subprocess.check_output", "graspd.tasks", "graspd.worker.process.main.run_worker"]
)
def test_a_forged_function_name_is_refused(rq_queue: RqQueue, function: str, tmp_path: Path) -> None:
    witness = tmp_path / "witness"
    with pytest.raises(TaskRefused, match="no task of graspd"):
        fetch(rq_queue, forge(rq_queue, function, f"touch {witness}")).perform()
    assert not witness.exists()


def test_a_method_of_a_forged_object_is_refused(rq_queue: RqQueue) -> None:
    job = forge(rq_queue, TASK_FUNCTION)
    data = json.dumps([TASK_FUNCTION, {"an": "object"}, [{}], {}]).encode()
    rq_queue.connection.hset(f"rq:job:{job}", "data", data)
    with pytest.raises(TaskRefused):
        fetch(rq_queue, job)


@pytest.mark.parametrize("arguments", [(), (["no", "message"],), ("text",)])
def test_a_task_without_a_message_is_refused(rq_queue: RqQueue, arguments: tuple[Any, ...]) -> None:
    with pytest.raises(TaskRefused):
        fetch(rq_queue, forge(rq_queue, TASK_FUNCTION, *arguments))


def test_a_task_names_no_function_that_rq_could_call(rq_queue: RqQueue) -> None:
    """Whoever has RQ's own worker look into our lists runs nothing."""
    with pytest.raises(ValueError, match="Invalid attribute name"):
        fetch(rq_queue, forge(rq_queue, TASK_FUNCTION, {})).perform()


def test_pickled_data_is_never_unpickled(rq_queue: RqQueue, tmp_path: Path) -> None:
    witness = tmp_path / "witness"
    with pytest.raises(TaskRefused):
        fetch(rq_queue, forge(rq_queue, "os.system", _Bomb(str(witness)), serializer=DefaultSerializer))
    assert not witness.exists()


class _Bomb:
    def __init__(self, path: str) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return os.mknod, (self.path,)


def test_a_forged_job_keeps_nothing_but_its_message(rq_queue: RqQueue) -> None:
    hooks = {"on_success": Callback(os.getcwd), "on_failure": Callback(os.getcwd), "on_stopped": Callback(os.getcwd)}
    limits: dict[str, Any] = {"failure_ttl": 365 * 86400, "result_ttl": -1, "timeout": 1, "retry": Retry(max=1000)}
    name = forge(rq_queue, TASK_FUNCTION, {}, **hooks, **limits)
    told = {"origin": "elsewhere", "repeats_left": 1000, "webhooks": json.dumps([{"url": "http://127.0.0.1:9/"}])}
    rq_queue.connection.hset(f"rq:job:{name}", mapping=told)
    job = fetch(rq_queue, name)
    assert not any((job.success_callback, job.failure_callback, job.stopped_callback, job.webhooks))
    assert job.failure_ttl <= 3600 and job.result_ttl == 0
    assert (job.timeout, job.retries_left, job.repeats_left, job.origin) == (-1, None, None, "bulk-synthesize")
