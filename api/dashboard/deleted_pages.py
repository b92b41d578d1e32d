"""What was deleted: confirmed by its name before, and brought back afterwards."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Form, Request
from fastapi.responses import HTMLResponse, RedirectResponse

from api.dashboard.rendering import render
from api.routes.dependencies import DatasetsOf, DeletionsOf, JobsOf, TagsOf, may_read, may_submit
from service.model.errors import InputError
from service.store.records import What

router = APIRouter(include_in_schema=False)

#: Letters of a job's id that its page shows, and that its deletion is confirmed by.
SHORT_ID = 12
Typed = Annotated[str, Form(max_length=64)]


@router.get("/deleted", dependencies=[Depends(may_read)])
def deleted_page(request: Request, deletions: DeletionsOf, done: str = "") -> HTMLResponse:
    """All that can be restored; `done` names what was deleted just now."""
    found = deletions.recent()
    return render(request, "deleted.html", found=found, just_now=next((one for one in found if one.id == done), None))


@router.post("/deleted/{what}/{name}/restore", dependencies=[Depends(may_submit)])
def restore(what: What, name: str, deletions: DeletionsOf) -> RedirectResponse:
    """Bring a thing back and show it."""
    found = deletions.restore(what, name)
    pages = {"job": f"/jobs/{found.id}", "dataset": f"/datasets/{found.id}", "hand": f"/hands/{found.name}"}
    return RedirectResponse(pages.get(what, "/grasps" if what == "tag" else "/deleted"), status_code=303)


@router.post("/datasets/{name}/delete", dependencies=[Depends(may_submit)])
def delete_dataset(
    name: str, datasets: DatasetsOf, typed: Typed = "", with_snapshots: Annotated[bool, Form()] = False
) -> RedirectResponse:
    """Take a dataset away that has ended."""
    _confirmed(typed, name)
    datasets.delete(name, with_snapshots=with_snapshots)
    return _deleted(name)


@router.post("/jobs/{job_id}/delete", dependencies=[Depends(may_submit)])
def delete_job(job_id: str, jobs: JobsOf, typed: Typed = "") -> RedirectResponse:
    """Take a job away that has ended."""
    _confirmed(typed, job_id, job_id[:SHORT_ID])
    jobs.delete(job_id)
    return _deleted(job_id)


@router.post("/tags/{name}/delete", dependencies=[Depends(may_submit)])
def delete_tag(name: str, tags: TagsOf, typed: Typed = "") -> RedirectResponse:
    """Take a tag away; its grasps stay."""
    _confirmed(typed, name)
    tag = tags.one(name)
    tags.remove(name)
    return _deleted(tag.id)


def _confirmed(typed: str, *names: str) -> None:
    if typed.strip() not in names:
        raise InputError(f"nothing was deleted: to confirm it, type {names[-1]}")


def _deleted(id: str) -> RedirectResponse:
    return RedirectResponse(f"/deleted?done={id}", status_code=303)
