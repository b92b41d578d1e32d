"""Tasks into RQ's lists, many in one round trip; each is checked and appended in one step of Redis."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

from rq.job import Job, JobStatus
from rq.serializers import JSONSerializer
from rq.utils import now

from service.queue.allowed import FAILURE_TTL_S, TASK_FUNCTION, AllowedJob
from service.queue.port import Message

#: RQ's own script of this kind takes a round trip for each job.
_APPEND: Final = """
if redis.call('EXISTS', KEYS[1]) == 1 then return 0 end
redis.call('HSET', KEYS[1], unpack(ARGV, 2))
redis.call('RPUSH', KEYS[2], ARGV[1])
return 1
"""
#: Tasks of one round trip: a megabyte or two.
_AT_ONCE: Final = 500


class Appender:
    """Appends jobs that Redis does not know."""

    def __init__(self, connection: Any) -> None:
        self._connection = connection
        self._append = connection.register_script(_APPEND)

    def append(self, entries: Sequence[tuple[str, str, Message]], *, stale: Sequence[str]) -> int:
        """Jobs to the end of their lists.

        Args:
            entries: name of the RQ queue, id of the job, and its message.
            stale: keys that are removed before.

        Returns:
            how many were added; a job whose hash is there was not.
        """
        added = 0
        for start in range(0, len(entries), _AT_ONCE):
            with self._connection.pipeline(transaction=False) as pipe:
                if stale:
                    pipe.delete(*stale)
                    stale = ()
                some = entries[start : start + _AT_ONCE]
                pipe.sadd("rq:queues", *{f"rq:queue:{queue}" for queue, _, _ in some})
                for queue, job_id, message in some:
                    job = self._job(queue, job_id, message)
                    keys = [job.key, f"rq:queue:{queue}"]
                    self._append(keys=keys, args=[job_id, *_fields(job)], client=pipe)
                added += sum(pipe.execute()[-len(some) :])
        return added

    def _job(self, queue: str, job_id: str, message: Message) -> Job:
        job = AllowedJob.create(
            TASK_FUNCTION,
            args=(message.model_dump(mode="json", by_alias=True),),
            id=job_id,
            connection=self._connection,
            timeout=-1,  # the worker's own clock ends a task that takes too long: see `worker.process.main`
            result_ttl=0,
            failure_ttl=FAILURE_TTL_S,
            description=f"{message.stage} {message.task_id}",
            status=JobStatus.QUEUED,
            origin=queue,
            serializer=JSONSerializer,
        )
        job.enqueued_at = now()
        return job


def _fields(job: Job) -> list[Any]:
    return [part for name, value in job.to_dict().items() if value is not None for part in (name, value)]
