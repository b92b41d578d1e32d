"""Search of the command palette: pages, jobs, datasets, hands, objects and tags by their names."""

from typing import Annotated, Final

from fastapi import APIRouter, Query, Request
from fastapi.responses import HTMLResponse, RedirectResponse

from graspd.api.dashboard.rendering import NAVIGATION, render
from graspd.api.routes.dependencies import READ, JobsOf, OverviewOf

_MOST: Final = 5
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
    text = q.strip()
    found = [("page", name, path) for path, name in _PAGES if text.lower() in name.lower()]
    if text:
        found += overview.search(text, limit=_MOST)
        found += [
            (f"job, {job.state}", f"{job.hand} × {job.object} {job.id[:8]}", f"/jobs/{job.id}")
            for job in jobs.page(words=dict.fromkeys(text.split(), ()), limit=_MOST).items
        ]
    if go and found:
        return RedirectResponse(found[0][2], status_code=303)
    return render(request, "search.html", q=q, found=found)
