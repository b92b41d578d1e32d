"""`/v1/hands/{name}/corrections`: what was guessed wrongly of a hand, said rightly, is another hand."""

from __future__ import annotations

from fastapi import APIRouter, Depends, Request, Response
from pydantic import Field

from api.problems import responses
from api.routes.assets import store_correction
from api.routes.dependencies import AssetsOf, may_submit
from api.routes.long_requests import Turns
from service.index.views import AssetView
from service.model.domain import Name
from service.store.descriptions import HandCorrections

router = APIRouter(prefix="/v1/hands", tags=["hands"])


class CorrectionRequest(HandCorrections):
    """Corrections, and the name of the hand that has them."""

    name: Name | None = Field(None, description="of the corrected hand; default: the hand's name with the next number")


@router.post(
    "/{name}/corrections",
    status_code=202,
    dependencies=[Depends(may_submit)],
    responses=responses(400, 401, 403, 404, 409, 413, 422, 429, 503),
)
async def correct_hand(
    name: str, body: CorrectionRequest, request: Request, response: Response, assets: AssetsOf
) -> AssetView:
    """A hand of the same files with these corrections; a worker checks it. `name` may be a digest."""
    uploads: Turns = request.app.state.uploads
    asset = await uploads.run(store_correction, assets, name, body, body.name)
    response.headers["Location"] = f"/v1/hands/{asset.name}"
    response.headers["Retry-After"] = "1"
    return asset
