"""Workers, statistics, health, metrics, usage, deletions, restores, ended jobs and datasets, webhooks."""

import re
from collections.abc import AsyncIterable
from datetime import date
from typing import Annotated, get_args

from fastapi import APIRouter, Depends, Header, Path, Query, Request, Response
from fastapi.sse import EventSourceResponse, ServerSentEvent
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from graspd.api.access.auth import is_allowed
from graspd.api.access.keys import Scope
from graspd.api.catalog import events
from graspd.api.catalog.overview import DeletionView, usage_csv
from graspd.api.metrics import CONTENT_TYPE, Metrics
from graspd.api.models import Health, Worker
from graspd.api.routes import dependencies
from graspd.service.index.views import DeliveryView, EndView, Stats, UsageDay, WebhookView
from graspd.service.model.webhooks import MAX_URL, End
from graspd.service.store.records import What

router = APIRouter(tags=["system"])


@router.get("/v1/workers", dependencies=dependencies.READ)
def list_workers(overview: dependencies.OverviewOf) -> list[Worker]:
    """List workers with a recent heartbeat: device, present stage, age of the lease."""
    return overview.workers()


@router.get("/v1/stats", dependencies=dependencies.READ)
def get_stats(overview: dependencies.OverviewOf) -> Stats:
    """Return statistics of the whole service, from the index."""
    return overview.stats()


@router.get("/healthz")
async def healthz() -> dict[str, bool]:
    """Confirm that this process answers."""
    return {"ok": True}


@router.get("/readyz", responses={503: {"model": Health, "description": "A part does not answer"}})
def readyz(request: Request, overview: dependencies.OverviewOf, response: Response) -> Health:
    """Return the latency of Redis, index and store, the controller's state, and the number of workers.

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
    dependencies=[Depends(dependencies.require_metrics_access)],
    response_class=Response,
    responses={200: {"content": {"text/plain": {}}}},
)
def metrics(request: Request, overview: dependencies.OverviewOf) -> Response:
    """Return metrics as Prometheus text. If a part is down, only its series are missing."""
    values: Metrics = request.app.state.metrics
    return Response(values.render(overview.metrics_snapshot()), media_type=CONTENT_TYPE)


usage_router = APIRouter(tags=["usage"])


def _check_day(said: object) -> object:
    """Reject numbers (pydantic would read seconds since 1970) and times (it would drop the time of day)."""
    if isinstance(said, str) and not re.fullmatch(r"[0-9]{4}-[0-9]{2}-[0-9]{2}", said):
        raise ValueError("a day is written as 2026-01-31")
    return said


Day = Annotated[date, BeforeValidator(_check_day)]
Since = Annotated[Day | None, Query(description="first day (UTC); default: 30 days before the last day")]
Until = Annotated[Day | None, Query(description="last day (UTC); default: today")]


@usage_router.get("/v1/usage", dependencies=dependencies.READ)
def get_usage(usage: dependencies.UsageOf, since: Since = None, until: Until = None) -> list[UsageDay]:
    """Return grasps and seconds per day of the key's project, newest first; with `admin`, of all projects."""
    return usage.days(since, until)


@usage_router.get(
    "/v1/usage.csv",
    dependencies=dependencies.READ,
    response_class=Response,
    responses={200: {"content": {"text/csv": {}}, "description": "One line per day and project"}},
)
def get_usage_csv(usage: dependencies.UsageOf, since: Since = None, until: Until = None) -> Response:
    """Return the data of `/v1/usage` as CSV."""
    headers = {"Content-Disposition": 'attachment; filename="usage.csv"'}
    return Response(usage_csv(usage.days(since, until)), media_type="text/csv", headers=headers)


deletion_router = APIRouter(tags=["deletions"])

Name = Annotated[str, Path(max_length=64, description="name or id of the resource")]


@deletion_router.get("/v1/deletions", dependencies=dependencies.READ)
def list_deletions(deletions: dependencies.DeletionsOf) -> list[DeletionView]:
    """List deletions that can be undone, newest first."""
    return deletions.list_restorable()


def _add_restore(what: What) -> None:
    @deletion_router.post(f"/v1/{what}s/{{name}}/restore", dependencies=dependencies.SUBMIT, name=f"restore_{what}")
    def restore(name: Name, deletions: dependencies.DeletionsOf) -> DeletionView:
        """Restore a deleted resource unchanged, within the grace time (`GRASPD_SHARD_GRACE_S`)."""
        return deletions.restore(what, name)


for _kind in get_args(What):
    _add_restore(_kind)


event_router = APIRouter(tags=["events"])

WebhookId = Annotated[str, Path(max_length=64)]
AfterEnd = Annotated[int, Query(ge=0, lt=2**62, description="`seq` of the last known end; 0: return all ends")]


class DeliveryPage(BaseModel):
    """Page of ended jobs and datasets, and the number to continue from."""

    items: list[EndView]
    next: int = Field(description="`since` of the next request")


class WebhookRequest(BaseModel):
    """Address to notify when jobs and datasets end, and the states to report."""

    model_config = ConfigDict(extra="forbid")

    url: str = Field(max_length=MAX_URL, description="https://host/path")
    states: tuple[End, ...] = Field(("succeeded", "failed", "cancelled"), min_length=1, max_length=3)


class CreatedWebhook(WebhookView):
    """Webhook and the secret that signs its bodies."""

    secret: str = Field(description="shown only once")


@event_router.get("/v1/events", dependencies=dependencies.READ)
def list_ends(webhooks: dependencies.WebhooksOf, since: AfterEnd = 0, limit: dependencies.Limit = 50) -> DeliveryPage:
    """List ended jobs and datasets, oldest first. Ends are stored for 30 days; each appears at least once."""
    items = webhooks.end_events(since, limit=limit)
    return DeliveryPage(items=items, next=items[-1].seq if items else since)


@event_router.get("/v1/events/stream", dependencies=dependencies.READ, response_class=EventSourceResponse)
async def stream_ends(
    request: Request,
    webhooks: dependencies.WebhooksOf,
    since: AfterEnd = 0,
    last_event_id: Annotated[str | None, Header(max_length=20, description="takes precedence over `since`")] = None,
) -> AsyncIterable[ServerSentEvent]:
    """Stream an `end` event per ended job or dataset; a client that reconnects continues where it stopped."""
    start = int(last_event_id) if last_event_id and last_event_id.isascii() and last_event_id.isdigit() else since
    async for event in events.end_events(webhooks, min(start, 2**62), request):
        yield event


@event_router.post("/v1/webhooks", status_code=201, dependencies=dependencies.SUBMIT)
def add_webhook(body: WebhookRequest, response: Response, webhooks: dependencies.WebhooksOf) -> CreatedWebhook:
    """Add a webhook for ended jobs and datasets of the key's project. The secret is shown only once."""
    hook, secret = webhooks.add(body.url, body.states)
    response.headers["Location"] = f"/v1/webhooks/{hook.id}/deliveries"
    return CreatedWebhook(**hook.model_dump(), secret=secret)


@event_router.get("/v1/webhooks", dependencies=dependencies.SUBMIT)
def list_webhooks(webhooks: dependencies.WebhooksOf) -> list[WebhookView]:
    """List webhooks that the key may change, without their secrets."""
    return webhooks.all()


@event_router.get("/v1/webhooks/{webhook_id}/deliveries", dependencies=dependencies.SUBMIT)
def list_deliveries(
    webhook_id: WebhookId, webhooks: dependencies.WebhooksOf, limit: dependencies.Limit = 50
) -> list[DeliveryView]:
    """List deliveries of a webhook, newest first; stored for 30 days."""
    return webhooks.deliveries(webhook_id, limit=limit)


@event_router.delete("/v1/webhooks/{webhook_id}", status_code=204, dependencies=dependencies.SUBMIT)
def delete_webhook(webhook_id: WebhookId, webhooks: dependencies.WebhooksOf) -> None:
    """Delete a webhook."""
    webhooks.delete(webhook_id)
