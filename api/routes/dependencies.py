"""What routes ask for: the nouns of this application, and the right to use them."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from typing import Annotated, Any

from fastapi import Depends, FastAPI, Query, Request

from api.access.auth import authorize
from api.access.idempotency import Idempotency
from api.access.keys import Scope
from api.access.quotas import Quotas
from api.access.unfinished import unfinished
from api.catalog.assets import Assets
from api.catalog.comparison import Comparisons
from api.catalog.datasets import Datasets
from api.catalog.deletions import Deletions
from api.catalog.grasp_exports import GraspExports
from api.catalog.grasps import Grasps
from api.catalog.jobs import Jobs
from api.catalog.overview import Overview
from api.catalog.shards import Shards
from api.catalog.tags import Tags
from api.catalog.usage import Usage
from api.catalog.webhooks import Webhooks
from service.pipeline.backends import Services
from service.queue.connection import connect, redis_url
from service.store.store import Store

MAX_LIMIT = 200


def provide(app: FastAPI, services: Services) -> None:
    """Put what routes ask for over these services."""
    redis = connect(redis_url(services.settings), patience=1)
    state = app.state
    quotas = Quotas(
        services.settings,
        redis,
        lambda ids: unfinished(services.index, ids),
        limits_of=state.keys.limits_of,
        gpu_seconds=services.index.usage.gpu_seconds,
    )
    state.store = services.store
    state.grasps, state.shards = Grasps(services), Shards(services)
    state.jobs = Jobs(services, quotas, Idempotency(redis), state.grasps, state.shards)
    state.datasets, state.assets = Datasets(services, quotas), Assets(services)
    state.comparisons = Comparisons(services, state.datasets)
    state.overview, state.usage = Overview(services, state.jobs), Usage(services, state.keys)
    state.webhooks, state.tags = Webhooks(services), Tags(services, state.grasps)
    state.deletions = Deletions(services)
    state.grasp_exports = GraspExports(services, state.grasps, state.tags)


def may_read(request: Request) -> None:
    authorize(request, Scope.READ)


def may_submit(request: Request) -> None:
    authorize(request, Scope.SUBMIT)


def may_scrape(request: Request) -> None:
    """Whoever may read; or anybody, where the settings say so."""
    if request.app.state.settings.metrics_need_key:
        authorize(request, Scope.READ)


def _provided(name: str) -> Callable[[Request], Coroutine[Any, Any, Any]]:
    # A coroutine, because FastAPI would take a thread for a plain function.
    async def found(request: Request) -> Any:
        return getattr(request.app.state, name)

    return found


JobsOf = Annotated[Jobs, Depends(_provided("jobs"))]
DatasetsOf = Annotated[Datasets, Depends(_provided("datasets"))]
ComparisonsOf = Annotated[Comparisons, Depends(_provided("comparisons"))]
AssetsOf = Annotated[Assets, Depends(_provided("assets"))]
GraspsOf = Annotated[Grasps, Depends(_provided("grasps"))]
ShardsOf = Annotated[Shards, Depends(_provided("shards"))]
StoreOf = Annotated[Store, Depends(_provided("store"))]
UsageOf = Annotated[Usage, Depends(_provided("usage"))]
TagsOf = Annotated[Tags, Depends(_provided("tags"))]
ExportsOf = Annotated[GraspExports, Depends(_provided("grasp_exports"))]
DeletionsOf = Annotated[Deletions, Depends(_provided("deletions"))]
WebhooksOf = Annotated[Webhooks, Depends(_provided("webhooks"))]
OverviewOf = Annotated[Overview, Depends(_provided("overview"))]
Limit = Annotated[int, Query(ge=1, le=MAX_LIMIT, description="items on a page")]
Cursor = Annotated[str | None, Query(max_length=512, description="`next` of the page before")]
