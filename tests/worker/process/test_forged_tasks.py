"""Tasks, and what is none, that somebody wrote into Redis: a worker goes on."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rq import Queue
from rq.serializers import JSONSerializer

from graspd.service.model.states import Priority, Stage
from graspd.service.queue.port import EventKind
from tests.fakes import fake_synthesize, message_for


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
    "another function of ours": lambda redis, _: _job(redis, "graspd.service.queue.allowed.run_task", {}),
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
