"""`/v1/tags`: names that users give to grasps."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Path

from api.models import Selection, TagChange, TagRequest
from api.problems import responses
from api.routes.dependencies import TagsOf, may_read, may_submit
from service.index.views import TagView

router = APIRouter(prefix="/v1/tags", tags=["tags"])

TagName = Annotated[str, Path(max_length=64, description="name of the tag, or its id")]


@router.get("", dependencies=[Depends(may_read)], responses=responses(401, 403, 503))
def list_tags(tags: TagsOf) -> list[TagView]:
    """Tags of the key's project by name, with how many grasps have each."""
    return tags.all()


@router.post("", dependencies=[Depends(may_submit)], responses=responses(400, 401, 403, 404, 409, 413, 422, 503))
def give_tag(body: TagRequest, tags: TagsOf) -> TagChange:
    """Give a tag to grasps, named or all that pass a filter; it is made if it is not there."""
    return tags.give(body.name, body)


@router.get("/{name}", dependencies=[Depends(may_read)], responses=responses(401, 403, 404, 422, 503))
def get_tag(name: TagName, tags: TagsOf) -> TagView:
    """A tag; `GET /v1/grasps?tag=NAME` lists its grasps."""
    return tags.one(name)


@router.post(
    "/{name}/remove", dependencies=[Depends(may_submit)], responses=responses(400, 401, 403, 404, 409, 413, 422, 503)
)
def take_tag_off(name: TagName, body: Selection, tags: TagsOf) -> TagChange:
    """Take a tag off grasps, named or all that pass a filter."""
    return tags.take_off(name, body)


@router.delete(
    "/{name}", status_code=204, dependencies=[Depends(may_submit)], responses=responses(401, 403, 404, 409, 422, 503)
)
def delete_tag(name: TagName, tags: TagsOf) -> None:
    """Take a tag away; its grasps stay."""
    tags.remove(name)
