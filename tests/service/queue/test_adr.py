"""RQ: what its defaults lose that are switched off (decisions in docs/adr), and forged entries and jobs in Redis."""

import contextlib
import json
import os
import re
import time
import zlib
from collections.abc import Callable, Iterator
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from rq import Callback, Queue, Retry, SimpleWorker, Worker
from rq.command import send_stop_job_command
from rq.executions import Execution
from rq.job import Job
from rq.registry import BaseRegistry, ScheduledJobRegistry, StartedJobRegistry
from rq.serializers import DefaultSerializer, JSONSerializer
from rq.timeouts import BaseDeathPenalty
from rq.worker import BaseWorker

from graspd.api.metrics import Metrics, MetricsSnapshot
from graspd.service.model.clock import timestamp
from graspd.service.model.errors import TaskRefused, UnavailableError
from graspd.service.model.states import Priority, Stage, State
from graspd.service.pipeline import job_actions
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.controller import Controller
from graspd.service.pipeline.indexer import Indexer
from graspd.service.pipeline.leading import PART
from graspd.service.pipeline.lease_reaper import LeaseReaper
from graspd.service.queue.entries import TASK_FUNCTION, lease_registry_key, queue_name, sanitized_job
from graspd.service.queue.port import Event, EventKind, rq_id
from graspd.service.queue.rq_queue import EVENTS, METRICS, WORKERS, RqQueue, cancel_key, worker_key
from tests.conftest import PACKAGES, REPOSITORY
from tests.fakes import beat_of, request
from tests.service.conftest import service

NAME = queue_name(Priority.INTERACTIVE, Stage.SYNTHESIZE)
#: How long RQ's worker says that its lease lasts [s].
LEASE_S = 60


@pytest.fixture
def held(services: Services, rq_queue: RqQueue) -> tuple[Services, Job]:
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


WIP = "rq:wip:interactive-synthesize"
WAITING = "rq:queue:interactive-synthesize"
BEAT = asdict(beat_of(pid=2**70))
EVENT = {"kind": EventKind.FINISHED.value, "at": timestamp(), "stage": "synthesize", "task_id": "t"}


def _beat(redis: Any, name: bytes, **facts: object) -> None:
    redis.sadd(WORKERS, name)
    redis.set(b"graspd:worker:" + name, json.dumps({**BEAT, **facts}))


def _event(redis: Any, **facts: object) -> None:
    redis.xadd(EVENTS, {"e": json.dumps({**EVENT, **facts})})


_UP = {"schema": 1, "stage": "synthesize", "task_id": "../x", "job_id": "", "output": "../../x"}
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
        redis.hset("rq:job:X", "data", zlib.compress(json.dumps(["graspd.task", None, [_UP], {}]).encode())),
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
    with pytest.raises(TaskRefused):  # pickled data is not unpickled
        fetch(rq_queue, forge(rq_queue, function, _Bomb(str(witness)), serializer=DefaultSerializer))
    assert not witness.exists()


def test_no_method_or_function_of_a_forged_task_can_be_called(rq_queue: RqQueue) -> None:
    job = forge(rq_queue, TASK_FUNCTION)
    data = json.dumps([TASK_FUNCTION, {"an": "object"}, [{}], {}]).encode()
    rq_queue.connection.hset(f"rq:job:{job}", "data", data)
    with pytest.raises(TaskRefused):
        fetch(rq_queue, job)
    # Whoever has RQ's own worker look into our lists runs nothing.
    with pytest.raises(ValueError, match="Invalid attribute name"):
        fetch(rq_queue, forge(rq_queue, TASK_FUNCTION, {})).perform()


@pytest.mark.parametrize("arguments", [(), (["no", "message"],), ("text",)])
def test_a_task_without_a_message_is_refused(rq_queue: RqQueue, arguments: tuple[Any, ...]) -> None:
    with pytest.raises(TaskRefused):
        fetch(rq_queue, forge(rq_queue, TASK_FUNCTION, *arguments))


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
