"""Workers, statistics, health and metrics; `/v1/usage`; `/v1/deletions` and restores."""

from __future__ import annotations

import re
from datetime import date
from typing import Annotated, Final, get_args

from fastapi import APIRouter, Depends, Path, Query, Request, Response
from pydantic import BeforeValidator

from graspd.api.access.auth import is_allowed
from graspd.api.access.keys import Scope
from graspd.api.catalog.deletions import DeletionView
from graspd.api.catalog.overview import as_csv
from graspd.api.metrics import CONTENT_TYPE, Metrics
from graspd.api.models import Health, Worker
from graspd.api.problems import responses
from graspd.api.routes.dependencies import DeletionsOf, OverviewOf, UsageOf, may_read, may_scrape, may_submit
from graspd.service.index.views import Stats, UsageDay
from graspd.service.store.records import What

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


usage_router = APIRouter(tags=["usage"])


def _day(said: object) -> object:
    """A number would be read as seconds since 1970, and of a time its day would be taken."""
    if isinstance(said, str) and not re.fullmatch(r"[0-9]{4}-[0-9]{2}-[0-9]{2}", said):
        raise ValueError("a day is written as 2026-01-31")
    return said


Day = Annotated[date, BeforeValidator(_day)]
Since = Annotated[Day | None, Query(description="first day (UTC); default: a month before the last")]
Until = Annotated[Day | None, Query(description="last day (UTC); default: today")]


@usage_router.get("/v1/usage", dependencies=[Depends(may_read)], responses=responses(400, 401, 403, 422, 503))
def get_usage(usage: UsageOf, since: Since = None, until: Until = None) -> list[UsageDay]:
    """Grasps and seconds of each project on each day, the newest first: of the key's project, with `admin` of all."""
    return usage.days(since, until)


@usage_router.get(
    "/v1/usage.csv",
    dependencies=[Depends(may_read)],
    response_class=Response,
    responses=responses(
        400,
        401,
        403,
        422,
        503,
        others={200: {"content": {"text/csv": {}}, "description": "One line a day and project"}},
    ),
)
def get_usage_csv(usage: UsageOf, since: Since = None, until: Until = None) -> Response:
    """The same as a table."""
    headers = {"Content-Disposition": 'attachment; filename="usage.csv"'}
    return Response(as_csv(usage.days(since, until)), media_type="text/csv", headers=headers)


deletion_router = APIRouter(tags=["deletions"])

Name = Annotated[str, Path(max_length=64, description="its name, or its id")]
KINDS: Final[tuple[What, ...]] = get_args(What)


@deletion_router.get("/v1/deletions", dependencies=[Depends(may_read)], responses=responses(401, 403, 503))
def list_deletions(deletions: DeletionsOf) -> list[DeletionView]:
    """What can be restored, the newest first."""
    return deletions.recent()


def _add_restore(what: What) -> None:
    @deletion_router.post(
        f"/v1/{what}s/{{name}}/restore",
        dependencies=[Depends(may_submit)],
        responses=responses(401, 403, 404, 409, 422, 503),
        name=f"restore_{what}",
    )
    def restore(name: Name, deletions: DeletionsOf) -> DeletionView:
        """Bring back what was deleted within the grace time (`GRASPD_SHARD_GRACE_S`), as it was."""
        return deletions.restore(what, name)


for _kind in KINDS:
    _add_restore(_kind)
