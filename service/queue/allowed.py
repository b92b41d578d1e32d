"""Restriction of queued jobs to graspd's own task, regardless of what clients write to Redis.

RQ imports and calls any function named in a job's hash, even with the JSON serializer; likewise callbacks, and posts to
any webhook URL. A worker therefore rebuilds each job from its id and message only. It passes the message to its engine
and calls nothing that the job names.
"""

from __future__ import annotations

from typing import Any, Final

from redis.exceptions import RedisError
from rq import Queue
from rq.exceptions import DeserializationError
from rq.job import Job
from rq.serializers import JSONSerializer

from graspd.service.model.errors import TaskRefused
from graspd.service.queue.entries import is_type_error

TASK_FUNCTION: Final = "graspd.task"
#: Lifetime of the data of a broken job in Redis [s]. Results are not stored: events report them.
FAILURE_TTL_S: Final = 3600


def new_job(message: dict[str, Any], **options: Any) -> Job:
    """Make a job without timeout, results, retries, callbacks or webhooks."""
    lifetimes = {"timeout": -1, "result_ttl": 0, "failure_ttl": FAILURE_TTL_S}
    return Job.create(TASK_FUNCTION, args=(message,), **lifetimes, serializer=JSONSerializer, **options)


def allowed_job(job: Job, queue: Queue) -> Job:
    """Return a safe copy of a job from Redis; TaskRefused if the job is not a task of graspd."""
    try:
        name, message = str(job.func_name), job.args[0]
    except (DeserializationError, LookupError, TypeError):
        name, message = "what cannot be read", None
    if name != TASK_FUNCTION or job.instance is not None or not isinstance(message, dict):
        raise TaskRefused(f"the queue contains {name[:80]!r}, which is no task of graspd")
    return new_job(message, id=job.id, origin=queue.name, connection=job.connection, description=job.description)


def is_entry_error(error: Exception) -> bool:
    """Check whether RQ took an entry but could not parse it: unreadable entries are discarded."""
    if not hasattr(error, "job_id"):  # RQ sets job_id on errors of reading an entry's job.
        return isinstance(error, UnicodeDecodeError)
    return not isinstance(error, RedisError) or is_type_error(error)
