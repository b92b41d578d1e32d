"""RQ job and queue classes that run nothing but graspd's own task, whatever a Redis writer puts there.

RQ imports and calls any function that a job's hash names, JSON serializer or not; it does the same with callbacks, and
it posts to any webhook URL. Here a job's function is what this process says it is, and the rest is dropped.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from redis.exceptions import RedisError, ResponseError
from rq import Queue
from rq.exceptions import NoSuchJobError
from rq.job import Job
from rq.serializers import JSONSerializer

from service.model.errors import TaskRefused
from service.queue.entries import is_wrong_type, text

#: The one function name a job may carry.
TASK_FUNCTION: Final = "graspd.task"
#: How long Redis keeps what is left of a refused or broken job [s]. Results are not kept: events tell them.
FAILURE_TTL_S: Final = 3600

TaskFunction = Callable[[dict[str, Any]], None]


class AllowedJob(Job):  # type: ignore[misc]
    """A job whose function comes from a table of this process, not from Redis."""

    function: TaskFunction | None = None
    """What `TASK_FUNCTION` stands for; set in worker processes only."""

    @property
    def func(self) -> TaskFunction:
        """The task function; TaskRefused for any other name, and where this process runs no tasks."""
        if self.func_name != TASK_FUNCTION or self.instance is not None:
            raise TaskRefused(f"the queue asks for {str(self.func_name)[:80]!r}, which is no task of graspd")
        function = type(self).function
        if function is None:
            raise TaskRefused("this process runs no tasks; start `graspd worker`")
        return function

    @classmethod
    def fetch(cls, *args: Any, **options: Any) -> AllowedJob:
        """A job from Redis. One that cannot be read counts as gone: it must not end the worker that took it."""
        try:
            job: AllowedJob = super().fetch(*args, **options)
        except NoSuchJobError:
            raise
        except RedisError as error:
            if isinstance(error, ResponseError) and is_wrong_type(error):
                raise NoSuchJobError(f"an entry of the queue is no job: {error}") from None
            raise
        except Exception as error:
            raise NoSuchJobError(f"an entry of the queue cannot be read: {error}") from None
        return job

    def restore(self, raw_data: Any) -> None:
        """Read a job from Redis without what could reach outside graspd or outlive its use."""
        super().restore(raw_data)
        self._success_callback_name = self._failure_callback_name = self._stopped_callback_name = None
        self._success_callback = self._failure_callback = self._stopped_callback = None
        self.webhooks: list[Any] = []
        self._dependency_ids: list[str] = []
        self.retries_left = self.repeats_left = None
        self.result_ttl, self.failure_ttl = 0, FAILURE_TTL_S


class AllowedQueue(Queue):  # type: ignore[misc]
    """A queue of such jobs."""

    @classmethod
    def open(cls, name: str, connection: Any) -> AllowedQueue:
        """A queue by its name."""
        return cls(name, connection=connection, job_class=AllowedJob, serializer=JSONSerializer)

    @classmethod
    def lpop(cls, *args: Any, **options: Any) -> tuple[Any, str] | None:
        """The next entry; one that is no text names no job, and RQ passes over it."""
        return _readable(super().lpop(*args, **options))

    @classmethod
    def lmove(cls, *args: Any, **options: Any) -> tuple[Any, str] | None:
        return _readable(super().lmove(*args, **options))


def _readable(taken: tuple[Any, bytes] | None) -> tuple[Any, str] | None:
    return None if taken is None else (taken[0], text(taken[1]))
