"""`/v1/jobs`: submit, list, watch, cancel, retry, delete; `/v1/shards`: HDF5 files, with byte ranges."""

import re
from collections.abc import AsyncIterable
from typing import Annotated

from fastapi import APIRouter, Depends, Header, Query, Request, Response
from fastapi.responses import RedirectResponse, StreamingResponse
from fastapi.sse import EventSourceResponse, ServerSentEvent

from graspd.api.catalog import events
from graspd.api.models import Job, JobDetail, Shard
from graspd.api.problems import ApiError, problem_responses
from graspd.api.routes.dependencies import (
    READ,
    SUBMIT,
    UNCHANGED,
    JobsOf,
    PagingOf,
    ShardsOf,
    is_unmodified,
    range_applies,
)
from graspd.service.index.views import Page
from graspd.service.model.domain import JobRequest
from graspd.service.model.states import State
from graspd.service.store.columns import ShardKind

router = APIRouter(prefix="/v1/jobs", tags=["jobs"])

IdempotencyKey = Annotated[str | None, Header(max_length=255, description="the same key with another body is refused")]


@router.post(
    "",
    status_code=202,
    dependencies=SUBMIT,
    responses={200: {"model": JobDetail, "description": "The job existed already and has ended"}},
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
    prefix: Annotated[str, Query(max_length=32, description="first characters of the ids")] = "",
) -> Page[Job]:
    """List jobs, newest first."""
    page = jobs.page(state=state, hand=hand, object=object, prefix=prefix, limit=paging.limit, cursor=paging.cursor)
    return paging.add_next_link(page)


@router.get("/{job_id}", dependencies=READ)
def get_job(job_id: str, jobs: JobsOf) -> JobDetail:
    """Return a job with the progress of its stages, failed attempts, mean metrics and shards."""
    return jobs.get(job_id)


@router.post("/{job_id}/cancel", status_code=202, dependencies=SUBMIT)
def cancel(job_id: str, jobs: JobsOf) -> JobDetail:
    """Cancel a job's waiting and running tasks; results remain."""
    return jobs.cancel(job_id)


@router.post("/{job_id}/retry", status_code=202, dependencies=SUBMIT)
def retry(job_id: str, jobs: JobsOf) -> JobDetail:
    """Run failed and cancelled tasks again; existing results are not made again."""
    return jobs.retry(job_id)


@router.delete("/{job_id}", status_code=204, dependencies=SUBMIT)
def delete(job_id: str, jobs: JobsOf) -> None:
    """Delete an ended job; `POST .../restore` restores it within the grace time."""
    jobs.delete(job_id)


def require_known_job(job_id: str, jobs: JobsOf) -> None:
    """Raise NotFoundError for an unknown job before its event stream starts with status 200."""
    jobs.get_progress(job_id)


@router.get("/{job_id}/events", dependencies=[*READ, Depends(require_known_job)], response_class=EventSourceResponse)
async def watch(job_id: str, request: Request, jobs: JobsOf) -> AsyncIterable[ServerSentEvent]:
    """Stream a job's progress: `progress` with the job at each change, `end` with its last state."""
    async for event in events.job_events(jobs, job_id, request):
        yield event


shard_router = APIRouter(prefix="/v1/shards", tags=["shards"])

_MEDIA_TYPE = "application/x-hdf5"
#: A number of more than 18 digits in a range is invalid, and the whole file is sent.
_RANGE = re.compile(r"bytes=([0-9]{0,18})-([0-9]{0,18})")


@shard_router.get("", dependencies=READ)
def list_shards(
    shards: ShardsOf,
    paging: PagingOf,
    job: Annotated[str | None, Query(max_length=64)] = None,
    kind: ShardKind | None = None,
) -> Page[Shard]:
    """List shards, all or those of a job."""
    return paging.add_next_link(shards.page(job=job, kind=kind, limit=paging.limit, cursor=paging.cursor))


@shard_router.get("/{shard_id}", dependencies=READ)
def get_shard(shard_id: str, shards: ShardsOf) -> Shard:
    """Return a shard with its whole manifest."""
    return shards.get(shard_id)


@shard_router.get(
    "/{shard_id}/films/{row}/{camera}",
    dependencies=READ,
    response_class=Response,
    responses={200: {"content": {"video/mp4": {}}, "description": "The video"}},
)
def get_film(shard_id: str, row: int, camera: str, shards: ShardsOf) -> Response:
    """Send the film of one camera of the episode of a grasp, by its row in the base shard."""
    headers = {"Cache-Control": "private, max-age=31536000, immutable"}
    return Response(shards.film(shard_id, row, camera), media_type="video/mp4", headers=headers)


@shard_router.head("/{shard_id}/file", dependencies=READ, include_in_schema=False)
@shard_router.get(
    "/{shard_id}/file",
    dependencies=READ,
    response_class=StreamingResponse,
    responses=problem_responses(416)
    | {
        200: {"content": {_MEDIA_TYPE: {}}, "description": "The file"},
        206: {"content": {_MEDIA_TYPE: {}}, "description": "The requested bytes"},
        304: {"description": UNCHANGED},
        307: {"description": "The store serves the file at a signed address"},
    },
)
def get_file(shard_id: str, request: Request, shards: ShardsOf) -> Response:
    """Send the HDF5 file, or redirect to a signed address of the store. A damaged file is refused.

    Range, If-None-Match and If-Range are supported.
    """
    shard = shards.get_intact(shard_id)
    # The id depends on the content, so cached copies never become stale.
    headers = {"ETag": f'"{shard.sha256}"', "Cache-Control": "private, max-age=31536000, immutable"}
    if is_unmodified(request.headers, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    only_head = request.method == "HEAD"
    if not only_head and (address := shards.signed_url(shard)) is not None:
        return RedirectResponse(address, status_code=307)
    size = shards.size(shard)
    wanted = request.headers.get("range")
    span = None if only_head or not range_applies(request.headers, headers["ETag"]) else parse_range(wanted, size)
    start, end = span or (0, size)
    headers |= {
        "Accept-Ranges": "bytes",
        "Content-Length": str(end - start),
        "Content-Disposition": f'attachment; filename="{shard.kind}-{shard_id}.h5"',
    }
    if only_head:
        return Response(media_type=_MEDIA_TYPE, headers=headers)
    if span is not None:
        headers["Content-Range"] = f"bytes {start}-{end - 1}/{size}"
    chunks = shards.stream(shard, start, end - start)
    status = 200 if span is None else 206
    return StreamingResponse(chunks, status_code=status, media_type=_MEDIA_TYPE, headers=headers)


def parse_range(header: str | None, size: int) -> tuple[int, int] | None:
    """Return (start, end) of a single byte range; None to send the whole file (RFC 9110 §14.2)."""
    match = _RANGE.fullmatch(header.strip()) if header else None
    if match is None or match.groups() == ("", ""):
        return None
    first, last = match.groups()
    if not first:
        start, end = max(0, size - int(last)), size
    else:
        start, end = int(first), min(size, int(last) + 1) if last else size
    if end <= start:
        raise ApiError(416, f"the file has {size} bytes", headers={"Content-Range": f"bytes */{size}"})
    return start, end
