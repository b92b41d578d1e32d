"""List of jobs: search, order, saved views, and changes of many jobs."""

from typing import Annotated, Any, Final
from urllib.parse import parse_qsl, quote, unquote, urlencode

from fastapi import APIRouter, Form, Request
from fastapi.responses import HTMLResponse, RedirectResponse
from starlette.datastructures import FormData

from graspd.api.catalog.jobs import Jobs
from graspd.api.dashboard.forms import fields_of
from graspd.api.dashboard.rendering import render
from graspd.api.routes.dependencies import READ, SUBMIT, JobsOf, next_address
from graspd.service.model.errors import InputError
from graspd.service.model.states import State

PAGE_SIZE: Final = 50
#: Maximum number of jobs changed by one request; each takes some milliseconds.
MOST_CHANGED: Final = 500
#: Columns with an order, and their titles.
SORTS: Final = {"hand": "Job", "state": "State", "duration": "Duration", "created": "Created"}
_VIEWS_COOKIE: Final = "graspd_views"
_MOST_VIEWS: Final = 12
_VIEW_CHARACTERS: Final = 200
_DONE: Final = {"cancel": "cancelled", "retry": "queued again", "delete": "deleted"}

router = APIRouter(prefix="/jobs", include_in_schema=False)


@router.get("", dependencies=READ, response_model=None)
def jobs_page(request: Request, jobs: JobsOf) -> HTMLResponse | RedirectResponse:
    """List jobs; the URL has the search, the state and the order, without empty fields."""
    given = {key: value for key, value in request.query_params.items() if value}
    if len(given) < len(request.query_params):
        return RedirectResponse(f"/jobs?{urlencode(given)}" if given else "/jobs", status_code=303)
    did, done, why = (given.pop(key, "") for key in ("did", "done", "why"))
    cursor = given.pop("cursor", None)
    page = jobs.page(**_filters(request, given), limit=PAGE_SIZE, cursor=cursor)
    query = urlencode(given)
    views = _saved_views(request)
    return render(
        request,
        "jobs.html",
        page="/jobs",
        events="/events",
        refresh_s=5,
        jobs=page.items,
        next=next_address(request, page.next) if page.next else None,
        given={name: given.get(name, "") for name in ("q", "state", "sort", "order")},
        query=query,
        headings={sort: (title, *_heading(given, sort)) for sort, title in SORTS.items()},
        states=[(state, urlencode({**given, "state": state})) for state in ("", *State)],
        owners=_owner_names(request),
        views=views,
        view=next((name for name, saved in views.items() if saved == query), ""),
        did=f"{int(done):,} {'job' if done == '1' else 'jobs'} {_DONE[did]}."
        if did in _DONE and done.isdigit()
        else "",
        why=why[:300],
        most=MOST_CHANGED,
    )


@router.post("/act", dependencies=SUBMIT)
def act(
    request: Request, jobs: JobsOf, fields: Annotated[FormData, fields_of(MOST_CHANGED + 20)], action: str = ""
) -> RedirectResponse:
    """Cancel, retry or delete the selected jobs, or all that match the filter; deletion asks for their number."""
    filter = dict(parse_qsl(str(fields.get("filter", ""))[:1000]))
    chosen = [str(one) for one in fields.getlist("job")]
    if fields.get("all"):
        chosen = _all_ids(jobs, _filters(request, filter))
    if action not in _DONE or not 0 < len(chosen) <= MOST_CHANGED:
        raise InputError(f"select 1 to {MOST_CHANGED} jobs; {len(chosen)} are selected")
    if action == "delete" and str(fields.get("typed", "")).strip() != str(len(chosen)):
        raise InputError(f"nothing was deleted; to delete {len(chosen)} jobs, type {len(chosen)}")
    changed, problems = jobs.change(action, chosen)
    why = f"{len(problems)} unchanged, for example: {problems[0]}" if problems else ""
    said = {"did": action, "done": changed} | ({"why": why[:300]} if why else {})
    return RedirectResponse(f"/jobs?{urlencode({**filter, **said})}", status_code=303)


@router.post("/views", dependencies=READ)
def save_view(
    request: Request,
    name: Annotated[str, Form(min_length=1, max_length=40)],
    query: Annotated[str, Form(max_length=_VIEW_CHARACTERS)] = "",
    remove: Annotated[bool, Form()] = False,
) -> RedirectResponse:
    """Save the filters of the list under a name, or remove them; the browser keeps the views in a cookie."""
    views = {key: value for key, value in _saved_views(request).items() if key != name}
    if not remove:
        views = dict([*views.items(), (name, query)][-_MOST_VIEWS:])
    response = RedirectResponse(f"/jobs?{query}" if query else "/jobs", status_code=303)
    secure = request.url.scheme == "https"
    response.set_cookie(_VIEWS_COOKIE, quote(urlencode(views)), max_age=365 * 86400, samesite="strict", secure=secure)
    return response


def _saved_views(request: Request) -> dict[str, str]:
    text = unquote(request.cookies.get(_VIEWS_COOKIE, ""))[:4000]
    return dict(parse_qsl(text, keep_blank_values=True)[:_MOST_VIEWS])


def _owner_names(request: Request) -> dict[str, str]:
    return {key.id: key.name for key in request.app.state.keys.list()}


def _filters(request: Request, given: dict[str, str]) -> dict[str, Any]:
    """Return arguments of `Jobs.page`; a word also finds jobs of the keys with this name."""
    words = given.get("q", "")[:200].split()
    names = _owner_names(request)
    state, sort = given.get("state", ""), given.get("sort", "created")
    return {
        "words": {word: [id for id, name in names.items() if word.lower() in name.lower()] for word in words},
        "state": State(state) if state in set(State) else None,
        "sort": sort if sort in SORTS else "created",
        "descending": given.get("order") != "asc",
    }


def _all_ids(jobs: Jobs, filters: dict[str, Any]) -> list[str]:
    found, cursor = list[str](), None
    while len(found) <= MOST_CHANGED:
        page = jobs.page(**filters, limit=200, cursor=cursor)
        found += [job.id for job in page.items]
        if (cursor := page.next) is None:
            break
    return found


def _heading(given: dict[str, str], sort: str) -> tuple[str, str]:
    """Return the link of a column's title, which changes the order, and the present order; "" for none."""
    is_present = given.get("sort", "created") == sort
    descending = given.get("order") != "asc"
    order = "asc" if is_present and descending else "desc"
    present = ("descending" if descending else "ascending") if is_present else ""
    return f"/jobs?{urlencode({**given, 'sort': sort, 'order': order})}", present
