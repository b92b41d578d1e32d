"""List of jobs: search, order, and changes of the selected jobs; search of the command palette."""

from collections.abc import Iterable
from typing import Annotated, Any, Final
from urllib.parse import urlencode

from fastapi import APIRouter, Query, Request
from fastapi.responses import HTMLResponse, RedirectResponse
from starlette.datastructures import FormData

from graspd.api.catalog.jobs import Jobs
from graspd.api.dashboard.forms import fields_of
from graspd.api.dashboard.rendering import NAVIGATION, redirect, render
from graspd.api.routes.dependencies import READ, SUBMIT, JobsOf, OverviewOf, next_address
from graspd.service.model.errors import InputError
from graspd.service.model.states import State

#: Number of jobs on a page, and thus the maximum number changed by one request.
PAGE_SIZE: Final = 100
#: Columns with an order, and their titles.
SORTS: Final = {"hand": "Job", "state": "State", "duration": "Duration", "created": "Created"}
_DONE: Final = {"submit": "submitted", "cancel": "cancelled", "retry": "queued again", "delete": "deleted"}

router = APIRouter(prefix="/jobs", include_in_schema=False)


@router.get("", dependencies=READ, response_model=None)
def jobs_page(request: Request, jobs: JobsOf) -> HTMLResponse | RedirectResponse:
    """List jobs; the URL has the search, the state and the order, without empty fields."""
    given = {key: value for key, value in request.query_params.items() if value}
    if len(given) < len(request.query_params):
        return RedirectResponse(f"/jobs?{urlencode(given)}" if given else "/jobs", status_code=303)
    cursor = given.pop("cursor", None)
    state, sort, words = given.get("state", ""), given.get("sort", ""), given.get("q", "")[:200].split()
    owners = {key.id: key.name for key in request.app.state.keys.list()}
    page = jobs.page(
        words={word: [id for id, name in owners.items() if word.lower() in name.lower()] for word in words},
        state=State(state) if state in set(State) else None,
        sort=sort if sort in SORTS else "created",
        descending=given.get("order") != "asc",
        limit=PAGE_SIZE,
        cursor=cursor,
    )
    return render(
        request,
        "jobs.html",
        events="/events",
        refresh_s=5,
        jobs=page.items,
        next=next_address(request, page.next) if page.next else None,
        given=given,
        sorts=SORTS,
        states=("", *State),
        owners=owners,
    )


@router.post("/act", dependencies=SUBMIT)
def act(jobs: JobsOf, fields: Annotated[FormData, fields_of(PAGE_SIZE + 5)], action: str = "") -> RedirectResponse:
    """Cancel, retry or delete the selected jobs; deletion asks for their number."""
    chosen = [str(one) for one in fields.getlist("job")]
    if not chosen:
        raise InputError("no job is selected; select some")
    if action == "delete" and str(fields.get("typed", "")).strip() != str(len(chosen)):
        raise InputError(f"nothing was deleted; to delete {len(chosen)} jobs, type {len(chosen)}")
    query = str(fields.get("query", ""))[:1000]
    return change_jobs(jobs, action, chosen, f"/jobs?{query}" if query else "/jobs", ("cancel", "retry", "delete"))


def change_jobs(
    jobs: Jobs, action: str, wanted: Iterable[Any], page: str, offered: Iterable[str] = ("cancel", "retry")
) -> RedirectResponse:
    """Change jobs, or submit requests; tell on a page how many changed, and why others did not."""
    if action not in offered:
        raise InputError(f"jobs have no action {action!r} here; there are: {', '.join(offered)}")
    changed, problems = jobs.change(action, wanted)
    said = f"{changed:,} {'job' if changed == 1 else 'jobs'} {_DONE[action]}."
    if problems:
        said += f" {len(problems)} unchanged, for example: {problems[0]}"
    return redirect(page, said[:400])


_MOST: Final = 5
_MENU: Final = (*NAVIGATION, ("/submit", "Submit"), ("/compare", "Compare datasets"), ("/deleted", "Recently deleted"))

search_router = APIRouter(include_in_schema=False)


@search_router.get("/search", dependencies=READ, response_model=None)
def search_page(
    request: Request,
    jobs: JobsOf,
    overview: OverviewOf,
    q: Annotated[str, Query(max_length=100)] = "",
    go: bool = False,
) -> HTMLResponse | RedirectResponse:
    """List what a text finds; `go` leads to the first result."""
    text = q.strip()
    found = [("page", name, path) for path, name in _MENU if text.lower() in name.lower()]
    if text:
        found += overview.search(text, limit=_MOST)
        found += [
            (f"job, {job.state}", f"{job.hand} × {job.object} {job.id[:8]}", f"/jobs/{job.id}")
            for job in jobs.page(words=dict.fromkeys(text.split(), ()), limit=_MOST).items
        ]
    if go and found:
        return RedirectResponse(found[0][2], status_code=303)
    return render(request, "search.html", q=q, found=found)
