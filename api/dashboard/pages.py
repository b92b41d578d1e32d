"""The dashboard as a whole: its pages put together, the stream that moves them, the meaning of problem types."""

from __future__ import annotations

from collections.abc import AsyncIterable
from typing import Final

from fastapi import APIRouter, Depends, FastAPI, Request
from fastapi.responses import HTMLResponse
from fastapi.sse import EventSourceResponse, ServerSentEvent

from api.catalog import events
from api.dashboard import (
    choice_forms,
    comparison_pages,
    dataset_pages,
    deleted_pages,
    forms,
    grasp_pages,
    hand_pages,
    job_pages,
    service_pages,
    session,
    usage_pages,
)
from api.dashboard.expected import Expectations
from api.dashboard.pictures import Pictures
from api.dashboard.rendering import environment, render
from api.routes.dependencies import OverviewOf, may_read
from service.model.errors import ERRORS
from service.pipeline.backends import Services

router = APIRouter(include_in_schema=False)
#: Those of all pages, in the order in which they are asked.
routers: Final = (
    *(
        part.router
        for part in (
            service_pages,
            job_pages,
            grasp_pages,
            hand_pages,
            deleted_pages,
            dataset_pages,
            comparison_pages,
            usage_pages,
            forms,
            choice_forms,
            session,
        )
    ),
    router,
)


def install(app: FastAPI, services: Services) -> None:
    """What the pages need of the application, besides their routes."""
    app.state.templates = environment()
    app.state.pictures = Pictures(services.store)
    app.state.expectations = Expectations(services.index)


@router.get("/events", dependencies=[Depends(may_read)], response_class=EventSourceResponse)
async def watch(request: Request, overview: OverviewOf) -> AsyncIterable[ServerSentEvent]:
    """Says that something on the home page has changed."""
    async for event in events.service_events(overview, request):
        yield event


@router.get("/docs", dependencies=[Depends(may_read)])
def explorer(request: Request) -> HTMLResponse:
    """Every route, to look at and to try."""
    return render(request, "explorer.html")


@router.get("/problems")
@router.get("/problems/{slug}")
def problem_types(request: Request, slug: str = "") -> HTMLResponse:
    """What the types of problem documents mean."""
    types = [(name, error.status, (error.__doc__ or "").splitlines()[0]) for name, error in ERRORS.items()]
    types += [(name, status, text) for name, (status, text) in _HTTP_PROBLEMS.items()]
    return render(request, "problems.html", types=sorted(types, key=lambda row: (row[1], row[0])))


_HTTP_PROBLEMS: Final = {
    "bad-request": (400, "The body or the form cannot be read at all."),
    "unauthorized": (401, "A live key is needed."),
    "forbidden": (403, "The key's scope is too small, or the request comes from a foreign web page."),
    "method-not-allowed": (405, "This address does not take this method."),
    "unsupported-media-type": (415, "The body is compressed or otherwise encoded; only plain bodies are read."),
    "range-not-satisfiable": (416, "The range of bytes lies behind the end of the file."),
    "misdirected-request": (421, "The service does not answer to this host name while it is open."),
}
