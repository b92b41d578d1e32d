"""Workers, statistics, health and metrics; `/v1/usage`; `/v1/deletions` and restores."""

from __future__ import annotations

import re
from datetime import date
from typing import Annotated, get_args

from fastapi import APIRouter, Depends, Path, Query, Request, Response
from pydantic import BeforeValidator

from graspd.api.access.auth import is_allowed
from graspd.api.access.keys import Scope
from graspd.api.catalog.overview import DeletionView, as_csv
from graspd.api.metrics import CONTENT_TYPE, Metrics
from graspd.api.models import Health, Worker
from graspd.api.problems import responses
from graspd.api.routes.dependencies import READ, SUBMIT, DeletionsOf, OverviewOf, UsageOf, may_scrape
from graspd.service.index.views import Stats, UsageDay
from graspd.service.store.records import What

router = APIRouter(tags=["system"])


@router.get("/v1/workers", dependencies=READ)
def list_workers(overview: OverviewOf) -> list[Worker]:
    """List workers with a recent heartbeat: device, present stage, age of the lease."""
    return overview.workers()


@router.get("/v1/stats", dependencies=READ)
def get_stats(overview: OverviewOf) -> Stats:
    """Return statistics of the whole service, from the index."""
    return overview.stats()


@router.get("/healthz")
async def healthz() -> dict[str, bool]:
    """Confirm that this process answers; needs no thread."""
    return {"ok": True}


@router.get("/readyz", responses={503: {"model": Health, "description": "A part does not answer"}})
def readyz(request: Request, overview: OverviewOf, response: Response) -> Health:
    """Return the latency of Redis, index and store, whether a controller is alive, and live workers.

    Details of a fault are included only for callers that may read.
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
    responses=responses(others={200: {"content": {"text/plain": {}}}}),
)
def metrics(request: Request, overview: OverviewOf) -> Response:
    """Return metrics as Prometheus text. A scrape succeeds even if a part is down, without its series."""
    values: Metrics = request.app.state.metrics
    return Response(values.render(overview.snapshot()), media_type=CONTENT_TYPE)


usage_router = APIRouter(tags=["usage"])


def _day(said: object) -> object:
    """Reject numbers, which would be seconds since 1970, and times, which would be cut to their day."""
    if isinstance(said, str) and not re.fullmatch(r"[0-9]{4}-[0-9]{2}-[0-9]{2}", said):
        raise ValueError("a day is written as 2026-01-31")
    return said


Day = Annotated[date, BeforeValidator(_day)]
Since = Annotated[Day | None, Query(description="first day (UTC); default: a month before the last")]
Until = Annotated[Day | None, Query(description="last day (UTC); default: today")]


@usage_router.get("/v1/usage", dependencies=READ, responses=responses(400))
def get_usage(usage: UsageOf, since: Since = None, until: Until = None) -> list[UsageDay]:
    """Return each project's grasps and seconds per day, newest first; all projects with `admin`."""
    return usage.days(since, until)


@usage_router.get(
    "/v1/usage.csv",
    dependencies=READ,
    response_class=Response,
    responses=responses(400, others={200: {"content": {"text/csv": {}}, "description": "One line a day and project"}}),
)
def get_usage_csv(usage: UsageOf, since: Since = None, until: Until = None) -> Response:
    """Return the same as a table."""
    headers = {"Content-Disposition": 'attachment; filename="usage.csv"'}
    return Response(as_csv(usage.days(since, until)), media_type="text/csv", headers=headers)


deletion_router = APIRouter(tags=["deletions"])

Name = Annotated[str, Path(max_length=64, description="its name, or its id")]


@deletion_router.get("/v1/deletions", dependencies=READ)
def list_deletions(deletions: DeletionsOf) -> list[DeletionView]:
    """List what can be restored, newest first."""
    return deletions.recent()


def _add_restore(what: What) -> None:
    @deletion_router.post(
        f"/v1/{what}s/{{name}}/restore", dependencies=SUBMIT, responses=responses(404, 409), name=f"restore_{what}"
    )
    def restore(name: Name, deletions: DeletionsOf) -> DeletionView:
        """Restore a resource deleted within the grace time (`GRASPD_SHARD_GRACE_S`), unchanged."""
        return deletions.restore(what, name)


for _kind in get_args(What):
    _add_restore(_kind)
