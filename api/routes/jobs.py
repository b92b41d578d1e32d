"""`/v1/jobs`: submit, list, watch, cancel, retry, delete."""

from __future__ import annotations

from collections.abc import AsyncIterable
from typing import Annotated

from fastapi import APIRouter, Depends, Header, Query, Request, Response
from fastapi.sse import EventSourceResponse, ServerSentEvent

from graspd.api.catalog import events
from graspd.api.models import Job, JobDetail
from graspd.api.problems import responses
from graspd.api.routes.dependencies import READ, SUBMIT, JobsOf, PagingOf
from graspd.service.index.views import Page
from graspd.service.model.domain import JobRequest
from graspd.service.model.states import State

router = APIRouter(prefix="/v1/jobs", tags=["jobs"])

IdempotencyKey = Annotated[
    str | None,
    Header(max_length=255, description="the same key with another body is refused; the same request is the same job"),
]


@router.post(
    "",
    status_code=202,
    dependencies=SUBMIT,
    responses=responses(400, 404, 409, others={200: {"model": JobDetail, "description": "It has ended"}}),
)
def submit(body: JobRequest, response: Response, jobs: JobsOf, idempotency_key: IdempotencyKey = None) -> JobDetail:
    """Submit a job. Identical content gives the same job: its id follows from request, hand and object."""
    job = jobs.submit(body, idempotency_key=idempotency_key)
    response.headers["Location"] = f"/v1/jobs/{job.id}"
    if job.state.is_final:
        response.status_code = 200
    else:
        response.headers["Retry-After"] = "1"
    return job


@router.get("", dependencies=READ)
def list_jobs(
    jobs: JobsOf,
    paging: PagingOf,
    state: State | None = None,
    hand: Annotated[str | None, Query(max_length=64)] = None,
    object: Annotated[str | None, Query(max_length=64)] = None,
) -> Page[Job]:
    """List jobs, newest first."""
    page = jobs.page(state=state, hand=hand, object=object, limit=paging.limit, cursor=paging.cursor)
    return paging.linked(page)


@router.get("/{job_id}", dependencies=READ, responses=responses(404))
def get_job(job_id: str, jobs: JobsOf) -> JobDetail:
    """Return a job with the progress of its stages, failed attempts, mean metrics and shards."""
    return jobs.one(job_id)


@router.post("/{job_id}/cancel", status_code=202, dependencies=SUBMIT, responses=responses(404, 409))
def cancel(job_id: str, jobs: JobsOf) -> JobDetail:
    """Cancel a job's waiting and running tasks; results remain."""
    return jobs.cancel(job_id)


@router.post("/{job_id}/retry", status_code=202, dependencies=SUBMIT, responses=responses(404, 409))
def retry(job_id: str, jobs: JobsOf) -> JobDetail:
    """Run failed and cancelled tasks again; existing results are not made again."""
    return jobs.retry(job_id)


@router.delete("/{job_id}", status_code=204, dependencies=SUBMIT, responses=responses(404, 409))
def delete(job_id: str, jobs: JobsOf) -> None:
    """Delete an ended job. After a grace time its shards follow, unless another job needs them; until then
    `POST .../restore` restores the job."""
    jobs.delete(job_id)


def known_job(job_id: str, jobs: JobsOf) -> None:
    """Refuse an unknown job before its event stream starts: afterwards the status cannot change."""
    jobs.moving(job_id)


@router.get(
    "/{job_id}/events",
    dependencies=[*READ, Depends(known_job)],
    response_class=EventSourceResponse,
    responses=responses(404),
)
async def watch(job_id: str, request: Request, jobs: JobsOf) -> AsyncIterable[ServerSentEvent]:
    """Stream a job's progress: `progress` with the job at each change, `end` with its last state."""
    async for event in events.job_events(jobs, job_id, request):
        yield event
