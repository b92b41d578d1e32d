"""Where RQ keeps things in Redis, as RQ says: its own readers clean up as they read, so what only looks reads keys."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from rq import Queue, Worker
from rq.executions import Execution, ExecutionRegistry
from rq.job import Job
from rq.registry import FailedJobRegistry, StartedJobRegistry
from rq.worker_registration import WORKERS_BY_QUEUE_KEY

#: Names of all lists that a task was ever put into, and of all workers.
LISTS: Final[str] = Queue.redis_queues_keys
WORKERS: Final[str] = Worker.redis_workers_keys


def list_key(name: str) -> str:
    """List of waiting tasks."""
    return f"{Queue.redis_queue_namespace_prefix}{name}"


def list_name(key: str) -> str:
    """Name of a list by its key."""
    return key.removeprefix(Queue.redis_queue_namespace_prefix)


def held_key(name: str) -> str:
    """Leases of the tasks that were taken from a list."""
    return str(StartedJobRegistry.key_template.format(name))


def failed_key(name: str) -> str:
    """Tasks of a list that RQ calls failed."""
    return str(FailedJobRegistry.key_template.format(name))


def job_key(job: str) -> str:
    """What is known of a task and attempt."""
    return f"{Job.redis_job_namespace_prefix}{job}"


def worker_key(name: str) -> str:
    """What RQ knows of a worker."""
    return f"{Worker.redis_worker_namespace_prefix}{name}"


def workers_key(name: str) -> str:
    """Workers that look into a list."""
    return str(WORKERS_BY_QUEUE_KEY % name)


def execution_keys(entry: str) -> tuple[str, str]:
    """Of a lease: the execution that it is of, and all executions of its task."""
    job, _, execution = entry.partition(":")
    return Execution(execution, job, connection=None).key, str(ExecutionRegistry.key_template.format(job))


def kinds(lists: list[str]) -> Iterator[tuple[str, str]]:
    """Keys of lists, each with its type in Redis."""
    for name in lists:
        yield list_key(name), "list"
        yield held_key(name), "zset"
        yield failed_key(name), "zset"
        yield workers_key(name), "set"
