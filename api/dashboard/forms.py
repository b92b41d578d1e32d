"""Forms of the pages: submit, cancel, retry. They work without JavaScript and answer with a page."""

from __future__ import annotations

import time
from typing import Any, Final

from fastapi import APIRouter, Depends, Request
from fastapi.responses import HTMLResponse, RedirectResponse
from pydantic import ValidationError
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import FormData, UploadFile

from api.catalog import Catalog
from api.dashboard.rendering import render
from api.dependencies import CatalogOf, may_read, may_submit
from api.routes.assets import store_upload
from service.domain import OFFERED, AssetKind, JobRequest
from service.errors import GraspdError, InputError
from service.index.views import AssetView

router = APIRouter(include_in_schema=False)

_CHECK_WAIT_S: Final = 15.0

_DEFAULTS: Final[dict[str, Any]] = {
    "hand": "allegro", "object": "mug", "grasps": 32, "fidelity": "standard", "seed": 0, "friction": 1.0,
    "scenes": 0, "views": 0, "stereo": False, "width": 320, "height": 240,
}  # fmt: skip


@router.get("/submit", dependencies=[Depends(may_read)])
def submit_page(request: Request, catalog: CatalogOf) -> HTMLResponse:
    """The form; parameters of the address fill it in."""
    given = {key: value for key, value in request.query_params.items() if key in _DEFAULTS}
    return _form(request, catalog, _DEFAULTS | given)


@router.post("/submit", dependencies=[Depends(may_submit)], response_model=None)
async def submit(request: Request, catalog: CatalogOf) -> HTMLResponse | RedirectResponse:
    """Submit what the form says, after the upload of a mesh if there is one."""
    async with request.form(max_files=1, max_fields=20) as fields:
        return await run_in_threadpool(_submit, request, catalog, fields)


@router.post("/jobs/{job_id}/cancel", dependencies=[Depends(may_submit)])
def cancel(job_id: str, catalog: CatalogOf) -> RedirectResponse:
    """Cancel a job and show it."""
    catalog.cancel(job_id)
    return RedirectResponse(f"/jobs/{job_id}", status_code=303)


@router.post("/jobs/{job_id}/retry", dependencies=[Depends(may_submit)])
def retry(job_id: str, catalog: CatalogOf) -> RedirectResponse:
    """Retry a job and show it."""
    catalog.retry(job_id)
    return RedirectResponse(f"/jobs/{job_id}", status_code=303)


def first_message(error: ValueError) -> str:
    """The first mistake of a validation, in one line."""
    if isinstance(error, ValidationError):
        entry = error.errors()[0]
        where = ".".join(str(token) for token in entry["loc"])
        message = entry["msg"].removeprefix("Value error, ")
        return f"{where}: {message}" if where else message
    return str(error)


def _submit(request: Request, catalog: Catalog, fields: FormData) -> HTMLResponse | RedirectResponse:
    form: dict[str, Any] = {
        name: fields[name] for name in _DEFAULTS if isinstance(fields.get(name), str) and fields[name] != ""
    }
    form["stereo"] = fields.get("stereo") == "true"
    shown = _DEFAULTS | form
    try:
        body = JobRequest.model_validate(form)
    except ValidationError as error:
        return _form(request, catalog, shown, errors=_by_field(error), status=422)
    try:
        file = fields.get("file")
        if isinstance(file, UploadFile) and file.filename:
            limit = request.app.state.settings.max_upload_bytes
            asset = store_upload(catalog, AssetKind.OBJECT, file, None, limit_bytes=limit)
            shown |= {"object": asset.name}
            body = body.model_copy(update={"object": asset.name})
            _await_check(catalog, asset)
        job = catalog.submit(body)
    except InputError as error:
        problem = {"title": error.title, "detail": str(error)}
        return _form(request, catalog, shown, problem=problem, status=error.status)
    return RedirectResponse(f"/jobs/{job.id}", status_code=303)


def _await_check(catalog: Catalog, asset: AssetView) -> None:
    """Give a worker a moment to check an upload, so that one press of the button is enough."""
    deadline = time.monotonic() + _CHECK_WAIT_S
    while asset.verdict is None and time.monotonic() < deadline:
        time.sleep(0.2)
        asset = catalog.asset(asset.kind, asset.digest)


def _by_field(error: ValidationError) -> dict[str, str]:
    errors: dict[str, str] = {}
    for entry in error.errors():
        # A rule over several fields has no place of its own; the only one says that views need scenes.
        name = str(entry["loc"][0]) if entry["loc"] else "scenes"
        errors.setdefault(name, entry["msg"].removeprefix("Value error, "))
    return errors


def _form(
    request: Request,
    catalog: Catalog,
    form: dict[str, Any],
    *,
    errors: dict[str, str] | None = None,
    problem: dict[str, str] | None = None,
    status: int = 200,
) -> HTMLResponse:
    return render(
        request,
        "submit.html",
        status=status,
        page="/submit",
        form=form,
        errors=dict.fromkeys([*_DEFAULTS, "file"], "") | (errors or {}),
        problem=problem,
        hands=_choices(catalog, AssetKind.HAND),
        objects=_choices(catalog, AssetKind.OBJECT),
        fidelities=[(name, name) for name in OFFERED],
        max_upload=request.app.state.settings.max_upload_bytes,
    )


def _choices(catalog: Catalog, kind: AssetKind) -> list[tuple[str, str]]:
    try:
        assets = catalog.assets(kind, limit=200).items
    except GraspdError:
        return []
    notes = {"refuse": " (refused)", None: " (being checked)"}
    return [(asset.name, asset.name + ("" if asset.builtin else notes.get(asset.verdict, ""))) for asset in assets]
