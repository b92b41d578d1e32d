"""`/v1/grasps`: the index of every grasp."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Query, Request, Response
from fastapi.responses import StreamingResponse

from api.catalog.grasp_exports import MEDIA_TYPES, Format, GraspExports
from api.catalog.tags import Tags
from api.models import GraspDetail, GraspExportQuery, GraspPageQuery, GraspQuery, Selection
from api.problems import responses
from api.routes.dependencies import ExportsOf, GraspsOf, TagsOf, may_read
from api.routes.paging import link_next
from service.index.views import GraspView, Page

router = APIRouter(prefix="/v1/grasps", tags=["grasps"])


@router.get("/{shard_id}/{row}", dependencies=[Depends(may_read)], responses=responses(401, 403, 404, 422, 503))
def get_grasp(shard_id: str, row: int, response: Response, grasps: GraspsOf) -> GraspDetail:
    """One grasp whole: its postures, and its quality at every contact threshold."""
    response.headers["Cache-Control"] = "private, max-age=86400"
    return grasps.one(shard_id, row)


@router.get(
    "/export",
    dependencies=[Depends(may_read)],
    response_class=StreamingResponse,
    responses=responses(
        401,
        403,
        404,
        413,
        422,
        500,
        503,
        others={200: {"content": {media: {} for media in MEDIA_TYPES.values()}, "description": "The file"}},
    ),
)
async def export_grasps(
    request: Request, tags: TagsOf, exports: ExportsOf, query: Annotated[GraspExportQuery, Query()]
) -> StreamingResponse:
    """All grasps that pass every filter: their rows as CSV or JSON, or base shards of them alone in a ZIP."""
    chosen = GraspQuery.model_validate(query.model_dump(exclude={"format"}))
    return await exported(request, tags, exports, Selection(filter=chosen), query.format)


async def exported(
    request: Request, tags: Tags, exports: GraspExports, selection: Selection, format: Format
) -> StreamingResponse:
    """The file of a selection, as an answer."""
    said = selection.model_dump(mode="json", exclude_none=True)
    made = await request.app.state.exports.run(lambda: exports.made(tags.chosen(selection), format, said))
    headers = {
        "Content-Length": str(made.size),
        "Content-Disposition": f'attachment; filename="{made.filename}"',
        "Cache-Control": "private, no-store",
    }
    return StreamingResponse(made.chunks, media_type=made.media_type, headers=headers)


@router.get("", dependencies=[Depends(may_read)], responses=responses(401, 403, 404, 422, 503))
def list_grasps(
    request: Request,
    response: Response,
    grasps: GraspsOf,
    query: Annotated[GraspPageQuery, Query()],
) -> Page[GraspView]:
    """Grasps that pass every filter, in the order asked for."""
    page = grasps.page(query, limit=query.limit, cursor=query.cursor)
    link_next(request, response, page.next)
    return page
