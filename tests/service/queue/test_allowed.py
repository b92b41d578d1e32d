"""What a stranger who can write to Redis cannot do."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest
from rq import Callback, Queue
from rq.exceptions import NoSuchJobError
from rq.serializers import DefaultSerializer, JSONSerializer

from service.model.errors import TaskRefused
from service.queue.allowed import TASK_FUNCTION, AllowedJob
from service.queue.rq_queue import RqQueue


def forge(queue: RqQueue, function: str, *args: Any, serializer: Any = JSONSerializer, **options: Any) -> str:
    """Put a job into a graspd queue the way a stranger would: with plain RQ."""
    plain = Queue("bulk-synthesize", connection=queue.connection, serializer=serializer)
    job: str = plain.enqueue_call(function, args=args, **options).id
    return job


def fetch(queue: RqQueue, job: str) -> AllowedJob:
    return AllowedJob.fetch(job, connection=queue.connection, serializer=JSONSerializer)


@pytest.mark.parametrize(
    "function", ["os.system", "subprocess.check_output", "graspd.tasks", "worker.process.main.run_worker"]
)
def test_a_forged_function_name_is_refused(rq_queue: RqQueue, function: str, tmp_path: Path) -> None:
    witness = tmp_path / "witness"
    job = fetch(rq_queue, forge(rq_queue, function, f"touch {witness}"))
    with pytest.raises(TaskRefused, match="no task of graspd"):
        job.perform()
    assert not witness.exists()


def test_a_method_of_a_forged_object_is_refused(rq_queue: RqQueue) -> None:
    job = fetch(rq_queue, forge(rq_queue, TASK_FUNCTION))
    job.data = json.dumps([TASK_FUNCTION, {"an": "object"}, [], {}]).encode()
    with pytest.raises(TaskRefused):
        job.perform()


def test_a_process_that_is_no_worker_runs_nothing(rq_queue: RqQueue) -> None:
    with pytest.raises(TaskRefused, match="graspd worker"):
        fetch(rq_queue, forge(rq_queue, TASK_FUNCTION, {})).perform()


def test_callbacks_and_webhooks_from_redis_are_dropped(rq_queue: RqQueue) -> None:
    hooks = {"on_success": Callback(os.getcwd), "on_failure": Callback(os.getcwd), "on_stopped": Callback(os.getcwd)}
    name = forge(rq_queue, "os.getcwd", **hooks)
    rq_queue.connection.hset(f"rq:job:{name}", "webhooks", json.dumps([{"url": "http://127.0.0.1:9/"}]))
    job = fetch(rq_queue, name)
    assert not any((job.success_callback, job.failure_callback, job.stopped_callback, job.webhooks))


def test_pickled_data_is_never_unpickled(rq_queue: RqQueue, tmp_path: Path) -> None:
    witness = tmp_path / "witness"
    job = fetch(rq_queue, forge(rq_queue, "os.system", _Bomb(str(witness)), serializer=DefaultSerializer))
    with pytest.raises(Exception):  # noqa: B017 - RQ wraps whatever the JSON parser says
        _ = job.func_name
    assert not witness.exists()


class _Bomb:
    def __init__(self, path: str) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return os.mknod, (self.path,)


def test_a_forged_job_cannot_stay_for_a_year(rq_queue: RqQueue) -> None:
    job = fetch(rq_queue, forge(rq_queue, "os.getcwd", failure_ttl=365 * 86400, result_ttl=-1))
    assert job.failure_ttl <= 3600
    assert job.result_ttl == 0


def test_an_entry_that_cannot_be_read_counts_as_gone(rq_queue: RqQueue) -> None:
    name = forge(rq_queue, "os.getcwd")
    rq_queue.connection.hset(f"rq:job:{name}", "created_at", "the day before yesterday")
    with pytest.raises(NoSuchJobError):
        fetch(rq_queue, name)
