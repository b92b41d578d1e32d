"""Workers, statistics, health and metrics."""

from __future__ import annotations

import contextlib

from fastapi import APIRouter, Depends, Request, Response

from api.dependencies import CatalogOf, may_read
from api.metrics import CONTENT_TYPE
from api.models import Health
from api.problems import responses
from service.errors import UnavailableError
from service.index.views import Stats, WorkerView

router = APIRouter(tags=["system"])


@router.get("/v1/workers", dependencies=[Depends(may_read)], responses=responses(401, 403, 503))
def list_workers(catalog: CatalogOf) -> list[WorkerView]:
    """Workers that gave a sign of life lately, with their device and what they do."""
    return catalog.workers()


@router.get("/v1/stats", dependencies=[Depends(may_read)], responses=responses(401, 403, 503))
def get_stats(catalog: CatalogOf) -> Stats:
    """The whole service in a few numbers, from the index."""
    return catalog.stats()


@router.get("/healthz")
def healthz() -> dict[str, bool]:
    """This process answers."""
    return {"ok": True}


@router.get("/readyz", responses={503: {"model": Health, "description": "A part does not answer"}})
def readyz(catalog: CatalogOf, response: Response) -> Health:
    """Redis, index and store, each with the time it took to answer."""
    health = catalog.health()
    if not health.ok:
        response.status_code = 503
        response.headers["Retry-After"] = "2"
    return health


@router.get("/metrics", response_class=Response, responses={200: {"content": {"text/plain": {}}}})
def metrics(request: Request, catalog: CatalogOf) -> Response:
    """Prometheus text format."""
    values = request.app.state.metrics
    health = catalog.health()
    for name, part in health.parts.items():
        values.set_part(name, None if part.latency_ms is None else part.latency_ms / 1000)
    # A scrape must show which part is down, so it succeeds without the counts.
    with contextlib.suppress(UnavailableError):
        values.set_counts(catalog.stats(), catalog.depths())
    return Response(values.render(), media_type=CONTENT_TYPE)
