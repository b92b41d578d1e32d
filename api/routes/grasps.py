"""`/v1/grasps`: index of all grasps; `/v1/tags`: names that users give to grasps."""

from typing import Annotated

from fastapi import APIRouter, Path, Query, Request, Response
from fastapi.responses import StreamingResponse

from graspd.api import models
from graspd.api.catalog.tags import MEDIA_TYPES, Format, GraspExports, Tags
from graspd.api.problems import problem_responses
from graspd.api.routes.dependencies import READ, SUBMIT, ExportsOf, GraspsOf, Paging, TagsOf
from graspd.service.index.views import GraspView, Page, TagView

router = APIRouter(prefix="/v1/grasps", tags=["grasps"])
_KEPT = {"Cache-Control": "private, max-age=86400"}


@router.get("/{shard_id}/{row}", dependencies=READ)
def get_grasp(shard_id: str, row: int, response: Response, grasps: GraspsOf) -> models.GraspDetail:
    """Return one grasp with its postures, and its metrics at every contact threshold."""
    response.headers.update(_KEPT)
    return grasps.get(shard_id, row)


@router.get("/{shard_id}/{row}/replay", dependencies=READ)
async def replay_grasp(request: Request, shard_id: str, row: int, grasps: GraspsOf) -> models.GraspReplay:
    """Simulate the validation of one grasp again; the API's machine needs the engine (`graspd[worker]`)."""
    found = await request.app.state.replays.run(grasps.replay, shard_id, row)
    return Response(found, media_type="application/json", headers=_KEPT)  # type: ignore[return-value]


@router.get("/{shard_id}/{row}/episodes", dependencies=READ)
def list_episodes(shard_id: str, row: int, grasps: GraspsOf) -> list[models.GraspEpisode]:
    """List the episodes of one grasp, newest first, with the addresses of their films."""
    return grasps.episodes(shard_id, row)


@router.get(
    "/export",
    dependencies=READ,
    response_class=StreamingResponse,
    responses=problem_responses(413, 500)
    | {200: {"content": {media: {} for media in MEDIA_TYPES.values()}, "description": "The file"}},
)
async def export_grasps(
    request: Request, tags: TagsOf, exports: ExportsOf, query: Annotated[models.GraspExportQuery, Query()]
) -> StreamingResponse:
    """Export all grasps that pass every filter: rows as CSV or JSON, or base shards in a ZIP."""
    chosen = models.GraspQuery.model_validate(query.model_dump(exclude={"format"}))
    return await export_response(request, tags, exports, models.Selection(filter=chosen), query.format)


async def export_response(
    request: Request, tags: Tags, exports: GraspExports, selection: models.Selection, format: Format
) -> StreamingResponse:
    said = selection.model_dump(mode="json", exclude_none=True)
    size, chunks = await request.app.state.exports.run(
        lambda: exports.export(tags.resolve_selection(selection), format, said)
    )
    headers = {"Content-Length": str(size), "Cache-Control": "private, no-store"}
    headers["Content-Disposition"] = f'attachment; filename="grasps.{format}"'
    return StreamingResponse(chunks, media_type=MEDIA_TYPES[format], headers=headers)


@router.get("", dependencies=READ)
def list_grasps(
    request: Request, response: Response, grasps: GraspsOf, query: Annotated[models.GraspPageQuery, Query()]
) -> Page[GraspView]:
    """List grasps that pass every filter, in the requested order."""
    paging = Paging(request, response, query.limit, query.cursor)
    return paging.add_next_link(grasps.page(query, limit=query.limit, cursor=query.cursor))


tag_router = APIRouter(prefix="/v1/tags", tags=["tags"])

TagName = Annotated[str, Path(max_length=64, description="name of the tag, or its id")]


@tag_router.get("", dependencies=READ)
def list_tags(tags: TagsOf) -> list[TagView]:
    """List tags of the key's project by name, with their numbers of grasps."""
    return tags.all()


@tag_router.post("", dependencies=SUBMIT)
def give_tag(body: models.TagRequest, tags: TagsOf) -> models.TagChange:
    """Give a tag to listed or filtered grasps; create the tag if it is new."""
    return tags.tag_grasps(body.name, body)


@tag_router.get("/{name}", dependencies=READ)
def get_tag(name: TagName, tags: TagsOf) -> TagView:
    """Return a tag; `GET /v1/grasps?tag=NAME` lists its grasps."""
    return tags.get(name)


@tag_router.post("/{name}/remove", dependencies=SUBMIT)
def remove_tag(name: TagName, body: models.Selection, tags: TagsOf) -> models.TagChange:
    """Remove a tag from listed or filtered grasps."""
    return tags.untag_grasps(name, body)


@tag_router.delete("/{name}", status_code=204, dependencies=SUBMIT)
def delete_tag(name: TagName, tags: TagsOf) -> None:
    """Delete a tag; its grasps remain."""
    tags.delete(name)
