"""`/v1/grasps`: the index of every grasp."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Query, Request, Response

from api.models import GraspDetail, GraspPageQuery
from api.problems import responses
from api.routes.dependencies import GraspsOf, may_read
from api.routes.paging import link_next
from service.index.views import GraspView, Page

router = APIRouter(prefix="/v1/grasps", tags=["grasps"])


@router.get("/{shard_id}/{row}", dependencies=[Depends(may_read)], responses=responses(401, 403, 404, 422, 503))
def get_grasp(shard_id: str, row: int, response: Response, grasps: GraspsOf) -> GraspDetail:
    """One grasp whole: its postures, and its quality at every contact threshold."""
    response.headers["Cache-Control"] = "private, max-age=86400"
    return grasps.one(shard_id, row)


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
