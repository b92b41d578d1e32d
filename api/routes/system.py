"""Workers, statistics, health and metrics."""

from __future__ import annotations

from fastapi import APIRouter, Depends, Request, Response

from api.access.auth import is_allowed
from api.access.keys import Scope
from api.metrics import CONTENT_TYPE, Metrics
from api.models import Health, Worker
from api.problems import responses
from api.routes.dependencies import OverviewOf, may_read, may_scrape
from service.index.views import Stats

router = APIRouter(tags=["system"])


@router.get("/v1/workers", dependencies=[Depends(may_read)], responses=responses(401, 403, 503))
def list_workers(overview: OverviewOf) -> list[Worker]:
    """Workers that gave a sign of life lately: device, stage in hand, age of the lease."""
    return overview.workers()


@router.get("/v1/stats", dependencies=[Depends(may_read)], responses=responses(401, 403, 503))
def get_stats(overview: OverviewOf) -> Stats:
    """The whole service in a few numbers, from the index."""
    return overview.stats()


@router.get("/healthz")
async def healthz() -> dict[str, bool]:
    """This process answers. No thread is needed for that."""
    return {"ok": True}


@router.get("/readyz", responses={503: {"model": Health, "description": "A part does not answer"}})
def readyz(request: Request, overview: OverviewOf, response: Response) -> Health:
    """Redis, index and store, each with the time it took to answer; whether a controller lives, and how many workers.

    What is wrong with a part is told to those who may read.
    """
    health = overview.health()
    if not health.ok:
        response.status_code = 503
        response.headers["Retry-After"] = "2"
    if not is_allowed(request, Scope.READ):
        parts = {name: part.model_copy(update={"detail": ""}) for name, part in health.parts.items()}
        health = health.model_copy(update={"parts": parts})
    return health


@router.get(
    "/metrics",
    dependencies=[Depends(may_scrape)],
    response_class=Response,
    responses=responses(401, 403, others={200: {"content": {"text/plain": {}}}}),
)
def metrics(request: Request, overview: OverviewOf) -> Response:
    """Prometheus text format. A scrape must show which part is down, so it succeeds without what that part knows."""
    values: Metrics = request.app.state.metrics
    return Response(values.render(overview.snapshot()), media_type=CONTENT_TYPE)
