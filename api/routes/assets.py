"""`/v1/hands`, `/v1/objects` and `/v1/networks`; a correction of a hand creates another hand."""

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from threading import BoundedSemaphore
from typing import Annotated, Final

from fastapi import APIRouter, Form, Query, Request, Response, UploadFile
from pydantic import Field
from starlette.datastructures import UploadFile as AnyUpload

from graspd.api.catalog.assets import Assets
from graspd.api.routes import dependencies
from graspd.api.uploads import files_of_upload, name_of_upload
from graspd.service.index.views import AssetView, Page
from graspd.service.model.base import Name
from graspd.service.model.errors import InputError, RateError
from graspd.service.model.states import AssetKind
from graspd.service.store.descriptions import HandCorrections

_GLB: Final = "model/gltf-binary"
#: Most uploads unpacked and packed at once in this process; each may need memory for one of its files.
_AT_ONCE: Final = BoundedSemaphore(dependencies.UPLOADS)
_TURN_S: Final = 20.0

_ZIPPED: Final = "Upload a file, or a ZIP of its folder. A worker checks the asset before a job uses it."
_NETWORK: Final = "Upload a proposal network: an `.npz` of the schema `graspd/proposals@1`."


@cache
def asset_router(kind: AssetKind) -> APIRouter:
    router = APIRouter(prefix=f"/v1/{kind.value}s", tags=[f"{kind.value}s"])

    @router.get("", dependencies=dependencies.READ, name=f"list_{kind}s")
    def list_assets(
        assets: dependencies.AssetsOf,
        paging: dependencies.PagingOf,
        refused: Annotated[bool, Query(description="include assets that the check refused")] = False,
    ) -> Page[AssetView]:
        """List all assets of this kind, newest first; refused ones only on request."""
        return paging.add_next_link(assets.page(kind, limit=paging.limit, cursor=paging.cursor, refused=refused))

    @router.get("/{name}", dependencies=dependencies.READ, name=f"get_{kind}")
    def get_asset(name: str, assets: dependencies.AssetsOf) -> AssetView:
        """Return an asset with the findings of its check."""
        return assets.get(kind, name)

    if kind is not AssetKind.NETWORK:
        _add_model_route(router, kind)

    @router.post(
        "",
        status_code=201 if kind is AssetKind.NETWORK else 202,
        dependencies=dependencies.SUBMIT,
        name=f"add_{kind}",
        description=_NETWORK if kind is AssetKind.NETWORK else _ZIPPED,
    )
    async def add_asset(
        file: UploadFile,
        response: Response,
        request: Request,
        assets: dependencies.AssetsOf,
        name: Annotated[Name | None, Form()] = None,
        options: Annotated[str, Form(description='JSON of asset.json keys: {"units": "mm"}', max_length=65536)] = "",
        self_test: Annotated[bool, Form(description="hands only: run the self-test, for some minutes")] = False,
        shared: Annotated[bool, Form(description="whether all projects may use it, not only the key's")] = False,
        rename: Annotated[bool, Form(description="use the next free name if the name is taken")] = False,
    ) -> AssetView:
        uploads: dependencies.RequestLimiter = request.app.state.uploads
        if self_test and kind is not AssetKind.HAND:
            raise InputError("self_test: only hands have a self-test")
        said = {"options": options, "self_test": self_test, "shared": shared, "rename": rename}
        limit = request.app.state.settings.max_upload_bytes
        asset = await uploads.run(store_upload, assets, kind, file, name, limit_bytes=limit, **said)
        response.headers["Location"] = f"/v1/{kind.value}s/{asset.name}"
        if asset.verdict is None:
            response.headers["Retry-After"] = "1"
        return asset

    @router.delete("/{name}", status_code=204, dependencies=dependencies.SUBMIT, name=f"delete_{kind}")
    def delete_asset(name: str, assets: dependencies.AssetsOf) -> None:
        """Delete an asset; refused while a job, dataset or set of objects needs it. `name` may be a digest."""
        assets.delete(kind, name)

    return router


def _add_model_route(router: APIRouter, kind: AssetKind) -> None:
    @router.get(
        "/{name}/model",
        dependencies=dependencies.READ,
        response_class=Response,
        responses={
            200: {"content": {_GLB: {}}, "description": "Binary glTF"},
            304: {"description": dependencies.UNCHANGED},
        },
        name=f"get_{kind}_model",
    )
    def get_model(name: str, request: Request, assets: dependencies.AssetsOf) -> Response:
        """Return the prepared hand (with its joint tree) or object, in metres; `name` may be a digest."""
        asset = assets.get(kind, name)
        # Content under a digest never changes; a name may later refer to another asset.
        lasting = "private, max-age=31536000, immutable" if name == asset.digest else "no-cache"
        data = assets.model(asset)
        headers = {"ETag": f'"{hashlib.sha256(data).hexdigest()}"', "Cache-Control": lasting}
        if dependencies.is_unmodified(request.headers, headers["ETag"]):
            return Response(status_code=304, headers=headers)
        return Response(data, media_type=_GLB, headers=headers)


def store_upload(
    assets: Assets,
    kind: AssetKind,
    file: AnyUpload,
    name: str | None,
    *,
    limit_bytes: int,
    options: str = "",
    **said: bool,
) -> AssetView:
    """Store an uploaded file as an immutable asset with a check task; `said`: options of `Assets.add`."""
    filename = file.filename or ""
    with _upload_slot():
        files = files_of_upload(kind, filename, file.file, limit_bytes=limit_bytes, options=options)
        return assets.add(kind, name or name_of_upload(filename), files, **said)


def store_correction(assets: Assets, name: str, corrections: HandCorrections, new_name: str | None) -> AssetView:
    """Store a corrected hand and its check task; the limit on uploads applies."""
    with _upload_slot():
        return assets.correct(name, corrections, new_name or "")


@contextmanager
def _upload_slot() -> Iterator[None]:
    if not _AT_ONCE.acquire(timeout=_TURN_S):
        raise RateError("too many uploads at once; try again in a moment")
    try:
        yield
    finally:
        _AT_ONCE.release()


correction_router = APIRouter(prefix="/v1/hands", tags=["hands"])


class CorrectionRequest(HandCorrections):
    """Corrections, and the name of the corrected hand."""

    name: Name | None = Field(None, description="name of the corrected hand; default: the hand's name with a number")


@correction_router.post("/{name}/corrections", status_code=202, dependencies=dependencies.SUBMIT)
async def correct_hand(
    name: str, body: CorrectionRequest, request: Request, response: Response, assets: dependencies.AssetsOf
) -> AssetView:
    """Create a hand from the same files with corrections; a worker checks it. `name` may be a digest."""
    uploads: dependencies.RequestLimiter = request.app.state.uploads
    asset = await uploads.run(store_correction, assets, name, body, body.name)
    response.headers["Location"] = f"/v1/hands/{asset.name}"
    response.headers["Retry-After"] = "1"
    return asset
