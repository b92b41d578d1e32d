"""Tasks, and what is none, that somebody wrote into Redis; tasks whose lease is gone, or whose end Redis refuses."""

import logging
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from rq import Queue
from rq.serializers import JSONSerializer

from graspd.service.model.messages import TaskMessage
from graspd.service.model.states import Priority, Stage
from graspd.service.queue.port import EventKind
from graspd.service.settings import Settings
from graspd.worker.process import engine
from graspd.worker.process.main import GraspWorker, run_worker
from graspd.worker.process.runner import Runner
from graspd.worker.stages.context import TaskContext
from tests.fakes import engine_of, fake_synthesize, message_for
from tests.waiting import until
from tests.worker.process.test_runner import broken


@pytest.fixture
def work(rq_queue, redis_server: str, tmp_path):
    settings = Settings(redis_url=redis_server, data_dir=tmp_path, device="cpu")

    def run(table, **options) -> bool:
        return run_worker(settings, start=engine_of(table), **{"burst": True} | options)

    return run


@pytest.fixture
def kinds(rq_queue):
    return lambda: [event.kind for _, event in rq_queue.events_after("0", limit=100, wait_s=0)]


def _waits(redis: Any, entry: str | bytes) -> None:
    redis.rpush("rq:queue:bulk-synthesize", entry)


def _job(redis: Any, function: str, *arguments: Any) -> str:
    queue = Queue("bulk-synthesize", connection=redis, serializer=JSONSerializer)
    return str(queue.enqueue_call(function, args=arguments).id)


FORGERIES: dict[str, Callable[[Any, Path], object]] = {
    "a name that is no text": lambda redis, _: _waits(redis, b"\xff"),
    "a name with blanks": lambda redis, _: _waits(redis, "a b"),
    "an attempt of 5,000 digits": lambda redis, _: _waits(redis, "a-" + "9" * 5000),
    "a string in the place of a job": lambda redis, _: (redis.set("rq:job:X", "x"), _waits(redis, "X")),
    "a job of no time": lambda redis, _: redis.hset(f"rq:job:{_job(redis, 'os.getcwd')}", "created_at", "yesterday"),
    "a job of no data": lambda redis, _: redis.hset(f"rq:job:{_job(redis, 'os.getcwd')}", "data", b"\xff\xfe"),
    "a command": lambda redis, witness: _job(redis, "os.system", f"touch {witness}"),
    "another function of ours": lambda redis, _: _job(redis, "graspd.service.queue.entries.run_task", {}),
    "a task without a message": lambda redis, _: _job(redis, "graspd.task", "text"),
    "a message of nothing": lambda redis, _: _job(redis, "graspd.task", {}),
}


@pytest.mark.parametrize("what", FORGERIES)
def test_what_is_no_task_is_passed_over(rq_queue, work: Any, kinds: Any, tmp_path: Path, what: str) -> None:
    witness = tmp_path / "witness"
    FORGERIES[what](rq_queue.connection, witness)
    rq_queue.enqueue([message_for()], Priority.BULK)
    assert work({Stage.SYNTHESIZE: fake_synthesize}), "the worker is none the worse"
    assert kinds()[:2] == [EventKind.STARTED, EventKind.FINISHED], "the task behind it is done"
    assert not witness.exists() and rq_queue.leases() == []


def test_a_task_that_was_taken_away_ends_in_a_line_and_no_traceback(rq_queue, work, caplog) -> None:
    def slow(message: TaskMessage, context: TaskContext):
        (lease,) = rq_queue.leases()
        rq_queue.release(lease)
        return fake_synthesize(message, TaskContext(context.store))

    rq_queue.enqueue([message_for()], Priority.BULK)
    with caplog.at_level(logging.INFO):
        assert work({Stage.SYNTHESIZE: slow})
    assert [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING] == []
    assert [record for record in caplog.records if "was taken from this worker" in record.getMessage()]
    assert not rq_queue.connection.keys("rq:job:*"), "nothing is left of it"


def test_a_worker_that_an_error_broke_off_has_work_left(rq_queue, work, monkeypatch) -> None:
    """Batch scripts start it again then; where none waits any more, they end."""
    table = {Stage.SYNTHESIZE: fake_synthesize}
    assert work(table), "none waits"

    def broken(*_: object) -> None:
        raise AttributeError("of another version")

    rq_queue.enqueue([message_for()], Priority.BULK)
    with monkeypatch.context() as patch:
        patch.setattr(GraspWorker, "prepare_execution", broken)
        assert not work(table)
    rq_queue.connection.flushdb()
    rq_queue.enqueue([message_for()], Priority.BULK)
    assert work(table, burst=False, max_tasks=1), "as many as were wanted"


def test_the_end_of_a_task_waits_until_redis_takes_writes(rq_queue, work, kinds) -> None:
    """Redis refuses writes here for want of replicas, as it does on a full disk."""

    def refuse(replicas: int) -> None:
        rq_queue.connection.config_set("min-replicas-to-write", replicas)

    def stage(message: TaskMessage, context: TaskContext):
        until(lambda: rq_queue.events_after("0", limit=1, wait_s=0), "it was told that the task began")
        refuse(1)
        threading.Timer(1.0, refuse, [0]).start()
        return fake_synthesize(message, context)

    rq_queue.enqueue([message_for()], Priority.BULK)
    try:
        assert work({Stage.SYNTHESIZE: stage})
    finally:
        refuse(0)
    assert rq_queue.leases() == [] and not rq_queue.connection.keys("rq:job:*")
    assert kinds()[:2] == [EventKind.STARTED, EventKind.FINISHED]


def test_the_worker_ends_and_leaves_the_other_tasks(rq_queue, work, kinds, tmp_path, monkeypatch, caplog) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(engine, "Runner", partial(Runner, check_device=broken))
    rq_queue.enqueue([message_for(), message_for(seed=1)], Priority.BULK)
    with caplog.at_level(logging.ERROR):
        assert not work({Stage.SYNTHESIZE: fake_synthesize}, burst=False), "its supervisor should know"
    assert kinds()[:2] == [EventKind.STARTED, EventKind.RETURNED] and kinds().count(EventKind.STARTED) == 1
    assert rq_queue.leases() == []
    assert any(line.startswith("this worker ends: CUDA error 700") for line in caplog.messages)
