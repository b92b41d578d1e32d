"""What a worker runs of a job in the queue: graspd's own task, whatever a Redis writer puts there.

RQ imports and calls any function that a job's hash names, JSON serializer or not; it does the same with callbacks, and
it posts to any webhook URL. A worker therefore makes a job anew of two facts, its id and its message, and calls nothing
of it: the message goes to its engine.
"""

from __future__ import annotations

from typing import Any, Final

from redis.exceptions import RedisError
from rq import Queue
from rq.exceptions import DeserializationError
from rq.job import Job
from rq.serializers import JSONSerializer

from graspd.service.model.errors import TaskRefused
from graspd.service.queue.entries import is_wrong_type

#: The one function name a job may carry.
TASK_FUNCTION: Final = "graspd.task"
#: How long Redis keeps what is left of a broken job [s]. Results are not kept: events tell them.
FAILURE_TTL_S: Final = 3600


def new_job(message: dict[str, Any], **options: Any) -> Job:
    """A job without end by time, results, retries, callbacks or webhooks: `worker.process.main` and the controller see
    to what is needed of these."""
    return Job.create(
        TASK_FUNCTION,
        args=(message,),
        timeout=-1,
        result_ttl=0,
        failure_ttl=FAILURE_TTL_S,
        serializer=JSONSerializer,
        **options,
    )


def allowed_job(job: Job, queue: Queue) -> Job:
    """The job that a worker may run in place of one from Redis; TaskRefused if that is no task of graspd."""
    try:
        name, message = str(job.func_name), job.args[0]
    except (DeserializationError, LookupError, TypeError):
        name, message = "what cannot be read", None
    if name != TASK_FUNCTION or job.instance is not None or not isinstance(message, dict):
        raise TaskRefused(f"the queue asks for {name[:80]!r}, which is no task of graspd")
    return new_job(message, id=job.id, origin=queue.name, connection=job.connection, description=job.description)


def is_of_an_entry(error: Exception) -> bool:
    """Whether RQ failed to read what it took from a queue, and not to take it: then the entry is nobody's."""
    if not hasattr(error, "job_id"):  # RQ puts it on what reading the entry's job raises
        return isinstance(error, UnicodeDecodeError)
    return not isinstance(error, RedisError) or is_wrong_type(error)
