"""What a user does to jobs: submit, cancel, retry. The planning behind it is in `planning`."""

from __future__ import annotations

from service.domain import JobRequest
from service.index.views import JobView
from service.parts import Parts


def submit(parts: Parts, request: JobRequest) -> tuple[JobView, bool]:
    """Record a job and queue its first tasks. The same request on the same hand and object is the same job.

    Returns:
        the job, and whether it is new. A failed or cancelled job is returned as it is: `retry` starts it again.

    Raises:
        NotFoundError: unknown hand or object.
        InputError: the hand or object was refused when it was checked.
        ConflictError: the check of the hand or object is still running.
        QueueUnavailable, StoreUnavailable, IndexUnavailable: nothing was recorded.
    """
    raise NotImplementedError


def cancel(parts: Parts, job_id: str) -> JobView:
    """Stop a job: waiting tasks never start, running ones stop at the next launch. Finished shards stay.

    Raises:
        NotFoundError: unknown job.
        ConflictError: the job is already finished.
    """
    raise NotImplementedError


def retry(parts: Parts, job_id: str) -> JobView:
    """Queue the failed and cancelled tasks of a job again, with fresh attempts.

    Raises:
        NotFoundError: unknown job.
        ConflictError: the job neither failed nor was cancelled.
    """
    raise NotImplementedError
