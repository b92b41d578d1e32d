"""Dashboard: its pages, the event stream that updates them, problem types, and the session.

Sign-in with a key sets a signed cookie, which is valid as long as the key.
"""

from __future__ import annotations

from collections.abc import AsyncIterable
from typing import Annotated, Final

from fastapi import APIRouter, FastAPI, Form, Request
from fastapi.responses import HTMLResponse, RedirectResponse
from fastapi.sse import EventSourceResponse, ServerSentEvent

from graspd.api.access.auth import SESSION_COOKIE
from graspd.api.access.keys import SESSION_S, KeyFile
from graspd.api.catalog import events
from graspd.api.dashboard import dataset_pages, forms, grasp_pages, hand_pages, job_pages, service_pages
from graspd.api.dashboard.forms import Expectations
from graspd.api.dashboard.job_pages import Pictures
from graspd.api.dashboard.rendering import environment, render
from graspd.api.routes.dependencies import READ, OverviewOf
from graspd.service.model.errors import ERRORS
from graspd.service.pipeline.backends import Services

router = APIRouter(include_in_schema=False)

#: Routers of all pages, in matching order.
routers: Final = (
    service_pages.router,
    job_pages.router,
    grasp_pages.router,
    hand_pages.router,
    dataset_pages.router,
    dataset_pages.comparison_router,
    forms.router,
    router,
)


def install(app: FastAPI, services: Services) -> None:
    app.state.templates = environment()
    app.state.pictures = Pictures(services.store)
    app.state.expectations = Expectations(services.index)


@router.get("/events", dependencies=READ, response_class=EventSourceResponse)
async def watch(request: Request, overview: OverviewOf) -> AsyncIterable[ServerSentEvent]:
    async for event in events.service_events(overview, request):
        yield event


@router.get("/docs", dependencies=READ)
def explorer(request: Request) -> HTMLResponse:
    return render(request, "explorer.html")


@router.get("/problems")
@router.get("/problems/{slug}")
def problem_types(request: Request, slug: str = "") -> HTMLResponse:
    types = [(name, error.status, (error.__doc__ or "").splitlines()[0]) for name, error in ERRORS.items()]
    types += [(name, status, text) for name, (status, text) in _HTTP_PROBLEMS.items()]
    return render(request, "problems.html", types=sorted(types, key=lambda row: (row[1], row[0])))


_HTTP_PROBLEMS: Final = {
    "bad-request": (400, "The body or form cannot be read."),
    "unauthorized": (401, "A valid key is required."),
    "forbidden": (403, "The scope of the key is insufficient, or the request comes from a foreign web page."),
    "method-not-allowed": (405, "The address does not support this method."),
    "unsupported-media-type": (415, "The body is compressed or otherwise encoded; only plain bodies are accepted."),
    "range-not-satisfiable": (416, "The byte range starts after the end of the file."),
    "misdirected-request": (421, "The service does not accept this host name while it has no keys."),
}


@router.get("/login")
def login_page(request: Request) -> HTMLResponse:
    key = request.scope["state"].get("key") if SESSION_COOKIE in request.cookies else None
    return render(request, "login.html", problem="", health=None, session=key.name if key else "")


@router.post("/logout")
def logout(request: Request) -> RedirectResponse:
    """End the session of this browser. Other sessions of the key continue; revoking it ends all of them."""
    response = RedirectResponse("/login", status_code=303)
    response.delete_cookie(SESSION_COOKIE, httponly=True, samesite="strict", secure=request.url.scheme == "https")
    return response


@router.post("/login", response_model=None)
def login(request: Request, key: Annotated[str, Form(max_length=200)]) -> HTMLResponse | RedirectResponse:
    keys: KeyFile = request.app.state.keys
    found = keys.find(key.strip())
    if found is None:
        return render(request, "login.html", session="", problem="The key is not valid.", health=None, status=401)
    response = RedirectResponse("/", status_code=303)
    response.set_cookie(
        SESSION_COOKIE,
        keys.open_session(found),
        max_age=SESSION_S,
        httponly=True,
        samesite="strict",
        secure=request.url.scheme == "https",
    )
    return response
