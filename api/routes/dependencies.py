"""Dependencies of routes: services, permissions, pages, threads, conditions (RFC 9110 §13)."""

import asyncio
import re
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Final, TypeVar

from anyio import CapacityLimiter, to_thread
from fastapi import Depends, FastAPI, Query, Request, Response
from starlette.datastructures import Headers

from graspd.api.access.auth import authorize
from graspd.api.access.keys import Scope
from graspd.api.access.quotas import Idempotency, Quotas, select_unfinished
from graspd.api.catalog.assets import Assets
from graspd.api.catalog.datasets import Datasets
from graspd.api.catalog.events import Webhooks
from graspd.api.catalog.grasps import Grasps
from graspd.api.catalog.jobs import Jobs, Shards
from graspd.api.catalog.overview import Deletions, Overview, Usage
from graspd.api.catalog.tags import GraspExports, Tags
from graspd.service.index.views import Page
from graspd.service.model.errors import UnavailableError
from graspd.service.pipeline.backends import Services
from graspd.service.queue.connection import connect, redis_url
from graspd.service.store.store import Store

T = TypeVar("T")


def install_services(app: FastAPI, services: Services) -> None:
    """Create the objects that routes depend on, from these services."""
    redis = connect(redis_url(services.settings), patience=1)
    state = app.state
    quotas = Quotas(
        services.settings,
        redis,
        lambda ids: select_unfinished(services.index, ids),
        limits_of=state.keys.limits_of,
        gpu_seconds=services.index.usage.gpu_seconds,
    )
    state.store = services.store
    state.grasps, state.shards = Grasps(services), Shards(services)
    state.jobs = Jobs(services, quotas, Idempotency(redis), state.grasps, state.shards)
    state.datasets, state.assets = Datasets(services, quotas), Assets(services)
    state.overview, state.usage = Overview(services, state.jobs), Usage(services, state.keys)
    state.webhooks, state.tags = Webhooks(services), Tags(services, state.grasps)
    state.deletions = Deletions(services)
    state.grasp_exports = GraspExports(services, state.grasps, state.tags)


def require_read(request: Request) -> None:
    authorize(request, Scope.READ)


def require_submit(request: Request) -> None:
    authorize(request, Scope.SUBMIT)


READ: Final = [Depends(require_read)]
SUBMIT: Final = [Depends(require_submit)]


def require_metrics_access(request: Request) -> None:
    """Raise ApiError unless the caller may read, or the settings permit all callers."""
    if request.app.state.settings.metrics_need_key:
        authorize(request, Scope.READ)


def _service_dependency(name: str) -> Callable[[Request], Coroutine[Any, Any, Any]]:
    # A coroutine, because FastAPI would run a plain function in a thread.
    async def get_service(request: Request) -> Any:
        return getattr(request.app.state, name)

    return get_service


JobsOf = Annotated[Jobs, Depends(_service_dependency("jobs"))]
DatasetsOf = Annotated[Datasets, Depends(_service_dependency("datasets"))]
AssetsOf = Annotated[Assets, Depends(_service_dependency("assets"))]
GraspsOf = Annotated[Grasps, Depends(_service_dependency("grasps"))]
ShardsOf = Annotated[Shards, Depends(_service_dependency("shards"))]
StoreOf = Annotated[Store, Depends(_service_dependency("store"))]
UsageOf = Annotated[Usage, Depends(_service_dependency("usage"))]
TagsOf = Annotated[Tags, Depends(_service_dependency("tags"))]
ExportsOf = Annotated[GraspExports, Depends(_service_dependency("grasp_exports"))]
DeletionsOf = Annotated[Deletions, Depends(_service_dependency("deletions"))]
WebhooksOf = Annotated[Webhooks, Depends(_service_dependency("webhooks"))]
OverviewOf = Annotated[Overview, Depends(_service_dependency("overview"))]
Limit = Annotated[int, Query(ge=1, le=200, description="items on a page")]
Cursor = Annotated[str | None, Query(max_length=512, description="`next` of the previous page")]


@dataclass(frozen=True)
class Paging:
    """Requested part of a list."""

    request: Request
    response: Response
    limit: int
    cursor: str | None

    def add_next_link(self, page: Page[T]) -> Page[T]:
        """Set the Link header (RFC 8288) to the next page, with the same filters."""
        if page.next is not None:
            self.response.headers["Link"] = f'<{next_address(self.request, page.next)}>; rel="next"'
        return page


async def _paging(request: Request, response: Response, limit: Limit = 50, cursor: Cursor = None) -> Paging:
    return Paging(request, response, limit, cursor)


PagingOf = Annotated[Paging, Depends(_paging)]


def next_address(request: Request, cursor: str) -> str:
    url = request.url.include_query_params(cursor=cursor)
    return f"{url.path}?{url.query}"


UPLOADS: Final = 4
#: Maximum number of concurrent forms with an upload; they also wait for the check of the upload.
FORMS: Final = 8
EXPORTS: Final = 2
_MOST_WAITING: Final = 32
_PATIENCE_S: Final = 20.0


class RequestLimiter:
    """Pool of threads with a limited number of waiting requests."""

    def __init__(self, at_once: int, *, patience_s: float = _PATIENCE_S) -> None:
        self._free = CapacityLimiter(at_once)
        self._patience_s = patience_s

    async def run(self, function: Callable[..., T], *args: Any, **options: Any) -> T:
        """Run a function in a thread of this pool; raise UnavailableError if none becomes free in time."""
        busy, turn = UnavailableError("too many requests of this kind at once; try again in a moment"), object()
        if not self._free.available_tokens and self._free.statistics().tasks_waiting >= _MOST_WAITING:
            raise busy
        try:
            async with asyncio.timeout(self._patience_s):
                await self._free.acquire_on_behalf_of(turn)
        except TimeoutError:
            raise busy from None
        try:
            return await to_thread.run_sync(partial(function, *args, **options), limiter=CapacityLimiter(1))
        finally:
            self._free.release_on_behalf_of(turn)


UNCHANGED: Final = "The file is unchanged: it has the tag of If-None-Match"
_TAGS: Final = re.compile(r'\s*((?:W/)?"[^"]*")\s*(?:,|$)')


def is_unmodified(headers: Headers, etag: str) -> bool:
    """Check whether If-None-Match is * or has the file's tag (weak comparison).
    If so, the response is 304."""
    given = headers.getlist("if-none-match")
    tags = {tag.removeprefix("W/") for value in given for tag in _TAGS.findall(value)}
    return etag in tags or any(value.strip() == "*" for value in given)


def range_applies(headers: Headers, etag: str) -> bool:
    """Check whether Range applies: If-Range is absent or has the tag; a date never matches."""
    given = headers.get("if-range")
    return given is None or given.strip() == etag
