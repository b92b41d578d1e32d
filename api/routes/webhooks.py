"""`/v1/events` and `/v1/webhooks`: ends of jobs and datasets, by polling, stream or webhook."""

from __future__ import annotations

from collections.abc import AsyncIterable
from typing import Annotated

from fastapi import APIRouter, Header, Path, Query, Request, Response
from fastapi.sse import EventSourceResponse, ServerSentEvent
from pydantic import BaseModel, ConfigDict, Field

from graspd.api.catalog import events
from graspd.api.problems import responses
from graspd.api.routes.dependencies import READ, SUBMIT, Limit, WebhooksOf
from graspd.service.index.views import DeliveryView, EndView, WebhookView
from graspd.service.model.webhooks import MAX_URL, End

router = APIRouter(tags=["events"])

WebhookId = Annotated[str, Path(max_length=64)]
Since = Annotated[int, Query(ge=0, lt=2**62, description="`seq` of the last end that is known; 0: from the first on")]


class DeliveryPage(BaseModel):
    """Page of ends, and the number to continue from."""

    items: list[EndView]
    next: int = Field(description="`since` of the next request")


class WebhookRequest(BaseModel):
    """Address to notify of ends."""

    model_config = ConfigDict(extra="forbid")

    url: str = Field(max_length=MAX_URL, description="https://host/path")
    states: tuple[End, ...] = Field(("succeeded", "failed", "cancelled"), min_length=1, max_length=3)


class CreatedWebhook(WebhookView):
    """Webhook and the secret that signs its bodies."""

    secret: str = Field(description="told this once")


@router.get("/v1/events", dependencies=READ)
def list_ends(webhooks: WebhooksOf, since: Since = 0, limit: Limit = 50) -> DeliveryPage:
    """List ended jobs and datasets in order. Ends are stored for 30 days; each appears at least once."""
    items = webhooks.ends(since, limit=limit)
    return DeliveryPage(items=items, next=items[-1].seq if items else since)


@router.get("/v1/events/stream", dependencies=READ, response_class=EventSourceResponse)
async def stream_ends(
    request: Request,
    webhooks: WebhooksOf,
    since: Since = 0,
    last_event_id: Annotated[str | None, Header(max_length=20, description="goes over `since`")] = None,
) -> AsyncIterable[ServerSentEvent]:
    """Stream the same: one `end` event each. A client that reconnects continues where it stopped."""
    start = int(last_event_id) if last_event_id and last_event_id.isascii() and last_event_id.isdigit() else since
    async for event in events.ends(webhooks, min(start, 2**62), request):
        yield event


@router.post("/v1/webhooks", status_code=201, dependencies=SUBMIT, responses=responses(400, 409))
def add_webhook(body: WebhookRequest, response: Response, webhooks: WebhooksOf) -> CreatedWebhook:
    """Add a webhook for ended jobs and datasets of the key's project. The secret is shown only once."""
    hook, secret = webhooks.add(body.url, body.states)
    response.headers["Location"] = f"/v1/webhooks/{hook.id}/deliveries"
    return CreatedWebhook(**hook.model_dump(), secret=secret)


@router.get("/v1/webhooks", dependencies=SUBMIT)
def list_webhooks(webhooks: WebhooksOf) -> list[WebhookView]:
    """List webhooks that the key may change, without their secrets."""
    return webhooks.all()


@router.get("/v1/webhooks/{webhook_id}/deliveries", dependencies=SUBMIT, responses=responses(404))
def list_deliveries(webhook_id: WebhookId, webhooks: WebhooksOf, limit: Limit = 50) -> list[DeliveryView]:
    """List deliveries of a webhook, newest first; stored for 30 days."""
    return webhooks.log(webhook_id, limit=limit)


@router.delete("/v1/webhooks/{webhook_id}", status_code=204, dependencies=SUBMIT, responses=responses(404))
def delete_webhook(webhook_id: WebhookId, webhooks: WebhooksOf) -> None:
    """Delete a webhook."""
    webhooks.delete(webhook_id)
