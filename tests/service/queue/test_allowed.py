"""What a stranger who can write to Redis cannot do."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest
from rq import Callback, Queue, Retry
from rq.job import Job
from rq.serializers import DefaultSerializer, JSONSerializer

from graspd.service.model.errors import TaskRefused
from graspd.service.queue.allowed import TASK_FUNCTION, allowed_job
from graspd.service.queue.rq_queue import RqQueue


def forge(queue: RqQueue, function: str, *args: Any, serializer: Any = JSONSerializer, **options: Any) -> str:
    """Put a job into a graspd queue the way a stranger would: with plain RQ."""
    plain = Queue("bulk-synthesize", connection=queue.connection, serializer=serializer)
    job: str = plain.enqueue_call(function, args=args, **options).id
    return job


def fetch(queue: RqQueue, job: str) -> Job:
    """What a worker would run of it."""
    bulk = Queue("bulk-synthesize", connection=queue.connection, serializer=JSONSerializer)
    return allowed_job(Job.fetch(job, connection=queue.connection, serializer=JSONSerializer), bulk)


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


def test_callbacks_and_webhooks_from_redis_are_dropped(rq_queue: RqQueue) -> None:
    hooks = {"on_success": Callback(os.getcwd), "on_failure": Callback(os.getcwd), "on_stopped": Callback(os.getcwd)}
    name = forge(rq_queue, TASK_FUNCTION, {}, **hooks)
    rq_queue.connection.hset(f"rq:job:{name}", "webhooks", json.dumps([{"url": "http://127.0.0.1:9/"}]))
    job = fetch(rq_queue, name)
    assert not any((job.success_callback, job.failure_callback, job.stopped_callback, job.webhooks))


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


def test_a_forged_job_cannot_stay_for_a_year(rq_queue: RqQueue) -> None:
    job = fetch(rq_queue, forge(rq_queue, TASK_FUNCTION, {}, failure_ttl=365 * 86400, result_ttl=-1))
    assert job.failure_ttl <= 3600
    assert job.result_ttl == 0


def test_a_forged_job_has_no_limit_retries_or_list_of_its_own(rq_queue: RqQueue) -> None:
    name = forge(rq_queue, TASK_FUNCTION, {}, timeout=1, retry=Retry(max=1000))
    rq_queue.connection.hset(f"rq:job:{name}", mapping={"origin": "elsewhere", "repeats_left": 1000})
    job = fetch(rq_queue, name)
    assert (job.timeout, job.retries_left, job.repeats_left, job.origin) == (-1, None, None, "bulk-synthesize")
