"""Search of the command palette: pages, jobs, datasets, hands, objects and tags by their names."""

from typing import Annotated, Final
from urllib.parse import quote

from fastapi import APIRouter, Query, Request
from fastapi.responses import HTMLResponse, RedirectResponse

from graspd.api.catalog.jobs import Jobs
from graspd.api.catalog.overview import Overview
from graspd.api.dashboard.rendering import NAVIGATION, render
from graspd.api.routes.dependencies import READ, JobsOf, OverviewOf

_MOST: Final = 5
_ADDRESSES: Final = {
    "dataset": "/datasets/{}",
    "hand": "/hands/{}",
    "object": "/objects/{}",
    "network": "/hands#networks",
    "tag": "/grasps?tag={}",
}
_PAGES: Final = (*NAVIGATION, ("/submit", "Submit"), ("/compare", "Compare datasets"), ("/deleted", "Recently deleted"))

router = APIRouter(include_in_schema=False)


@router.get("/search", dependencies=READ, response_model=None)
def search_page(
    request: Request,
    jobs: JobsOf,
    overview: OverviewOf,
    q: Annotated[str, Query(max_length=100)] = "",
    go: bool = False,
) -> HTMLResponse | RedirectResponse:
    """List what a text finds; `go` leads to the first result."""
    found = _find(jobs, overview, q.strip())
    if go and found:
        return RedirectResponse(found[0][2], status_code=303)
    return render(request, "search.html", q=q, found=found)


def _find(jobs: Jobs, overview: Overview, text: str) -> list[tuple[str, str, str]]:
    """Return kind, name and address of each result."""
    found = [("page", name, path) for path, name in _PAGES if text.lower() in name.lower()]
    if not text:
        return found
    names = [(kind, name, _ADDRESSES[kind].format(quote(name))) for kind, name in overview.names(text, limit=_MOST)]
    words = dict.fromkeys(text.split(), ())
    of_jobs = [
        (f"job, {job.state}", f"{job.hand} × {job.object} {job.id[:8]}", f"/jobs/{job.id}")
        for job in jobs.page(words=words, limit=_MOST).items
    ]
    return [*found, *names, *of_jobs]
