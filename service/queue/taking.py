"""More tasks of a kind for a worker that has one: taken off its list one by one, whoever else takes from there."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from redis.exceptions import ResponseError
from rq.exceptions import NoSuchJobError
from rq.serializers import JSONSerializer

from service.model.messages import TaskMessage
from service.queue import entries
from service.queue.allowed import TASK_FUNCTION, AllowedJob

#: Entries of the list that are looked at.
LOOKED_AT: Final = 256


def take_alike(
    connection: Any, queue: str, alike: Callable[[TaskMessage], bool], most: Callable[[int], int]
) -> list[AllowedJob]:
    """Waiting tasks, the oldest first, taken off the list.

    What is taken is in nobody's hands until its lease begins: a worker that ends before loses nothing, for the keeper
    looks for tasks that are nowhere. A forged entry is left for whoever comes to it.

    Args:
        connection: Redis.
        queue: name of the RQ queue.
        alike: whether a task is wanted.
        most: from how many of them are there to how many are taken.
    """
    key = f"rq:queue:{queue}"
    try:
        waiting = connection.lrange(key, 0, LOOKED_AT - 1)
    except ResponseError as error:
        if entries.is_wrong_type(error):
            return []
        raise
    found = [job for entry in dict.fromkeys(waiting) if (job := _job(connection, entry, alike)) is not None]
    # Another worker may take any of them meanwhile: it is ours only if it was we who removed it.
    return [job for job in found[: most(len(found))] if connection.lrem(key, 1, job.id)]


def message_of(job: AllowedJob) -> TaskMessage | None:
    """What a job asks for, if it is a task of graspd under its own name."""
    try:
        if job.func_name != TASK_FUNCTION or job.instance is not None:
            return None
        message = TaskMessage.model_validate(job.args[0])
    except Exception:  # forged data may fail anywhere
        return None
    return message if job.id == f"{message.task_id}-{message.attempt}" else None


def _job(connection: Any, entry: bytes, alike: Callable[[TaskMessage], bool]) -> AllowedJob | None:
    try:
        job = AllowedJob.fetch(entries.text(entry), connection=connection, serializer=JSONSerializer)
    except NoSuchJobError:
        return None
    message = message_of(job)
    return job if message is not None and alike(message) else None
