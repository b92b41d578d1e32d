"""`/v1/shards`: HDF5 files, with byte ranges."""

from __future__ import annotations

import re
from typing import Annotated, Literal

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import RedirectResponse, StreamingResponse

from graspd.api.models import Shard
from graspd.api.problems import ApiError, responses
from graspd.api.routes.dependencies import READ, PagingOf, ShardsOf, is_known, range_applies
from graspd.service.index.views import Page

router = APIRouter(prefix="/v1/shards", tags=["shards"])

_MEDIA_TYPE = "application/x-hdf5"
#: No file size has more than 18 digits; a longer number is no valid range, and the whole file is sent.
_RANGE = re.compile(r"bytes=([0-9]{0,18})-([0-9]{0,18})")


@router.get("", dependencies=READ, responses=responses(404))
def list_shards(
    shards: ShardsOf,
    paging: PagingOf,
    job: Annotated[str | None, Query(max_length=64)] = None,
    kind: Literal["base", "scene", "views"] | None = None,
) -> Page[Shard]:
    """List shards, all or those of a job."""
    return paging.linked(shards.page(job=job, kind=kind, limit=paging.limit, cursor=paging.cursor))


@router.get("/{shard_id}", dependencies=READ, responses=responses(404))
def get_shard(shard_id: str, shards: ShardsOf) -> Shard:
    """Return a shard with its whole manifest."""
    return shards.one(shard_id)


@router.head("/{shard_id}/file", dependencies=READ, include_in_schema=False)
@router.get(
    "/{shard_id}/file",
    dependencies=READ,
    response_class=StreamingResponse,
    responses=responses(
        404,
        416,
        others={
            200: {"content": {_MEDIA_TYPE: {}}, "description": "The file"},
            206: {"content": {_MEDIA_TYPE: {}}, "description": "The bytes asked for"},
            304: {"description": "What If-None-Match names is this file"},
            307: {"description": "The store hands the file out itself, under a signed address"},
        },
    ),
)
def get_file(shard_id: str, request: Request, shards: ShardsOf) -> Response:
    """Send the HDF5 file: from the store if it signs addresses, else through the API; Range is supported.

    If-None-Match and If-Range are supported. A file that does not match its checksum is refused.
    """
    shard = shards.intact(shard_id)
    # The id depends on the content, so cached copies never become stale.
    headers = {"ETag": f'"{shard.sha256}"', "Cache-Control": "private, max-age=31536000, immutable"}
    if is_known(request.headers, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    only_head = request.method == "HEAD"
    # A signed address is valid for GET only.
    if not only_head and (address := shards.address(shard)) is not None:
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
    """Return (start, end) of a single byte range; None to send the whole file (RFC 9110 §14.2).

    Raises:
        ApiError: 416, the range starts beyond the end of the file.
    """
    match = _RANGE.fullmatch(header.strip()) if header else None
    if match is None or match.groups() == ("", ""):
        return None
    first, last = match.groups()
    if not first:
        start, end = max(0, size - int(last)), size
    else:
        start, end = int(first), min(size, int(last) + 1) if last else size
    if start >= size or end <= start:
        raise ApiError(416, f"the file has {size} bytes", headers={"Content-Range": f"bytes */{size}"})
    return start, end
