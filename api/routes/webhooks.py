"""`/v1/events` and `/v1/webhooks`: what ended, asked for or told."""

from __future__ import annotations

from collections.abc import AsyncIterable
from typing import Annotated

from fastapi import APIRouter, Depends, Header, Path, Query, Request, Response
from fastapi.sse import EventSourceResponse, ServerSentEvent
from pydantic import BaseModel, ConfigDict, Field

from graspd.api.catalog import events
from graspd.api.problems import responses
from graspd.api.routes.dependencies import Limit, WebhooksOf, may_read, may_submit
from graspd.service.index.views import DeliveryView, EndView, WebhookView
from graspd.service.model.webhooks import MAX_URL, End

router = APIRouter(tags=["events"])

WebhookId = Annotated[str, Path(max_length=64)]
Since = Annotated[int, Query(ge=0, lt=2**62, description="`seq` of the last end that is known; 0: from the first on")]


class DeliveryPage(BaseModel):
    """The next ends, and where to go on."""

    items: list[EndView]
    next: int = Field(description="`since` of the next request")


class WebhookRequest(BaseModel):
    """An address that shall be told of ends."""

    model_config = ConfigDict(extra="forbid")

    url: str = Field(max_length=MAX_URL, description="https://host/path")
    states: tuple[End, ...] = Field(("succeeded", "failed", "cancelled"), min_length=1, max_length=3)


class CreatedWebhook(WebhookView):
    """A webhook, and what its bodies are signed with."""

    secret: str = Field(description="told this once")


@router.get("/v1/events", dependencies=[Depends(may_read)], responses=responses(401, 403, 422, 503))
def list_ends(webhooks: WebhooksOf, since: Since = 0, limit: Limit = 50) -> DeliveryPage:
    """Jobs and datasets that ended, in this order. Ends are kept for 30 days; none is left out, one may come twice."""
    items = webhooks.ends(since, limit=limit)
    return DeliveryPage(items=items, next=items[-1].seq if items else since)


@router.get(
    "/v1/events/stream",
    dependencies=[Depends(may_read)],
    response_class=EventSourceResponse,
    responses=responses(401, 403, 422, 503),
)
async def stream_ends(
    request: Request,
    webhooks: WebhooksOf,
    since: Since = 0,
    last_event_id: Annotated[str | None, Header(max_length=20, description="goes over `since`")] = None,
) -> AsyncIterable[ServerSentEvent]:
    """The same as a stream: `end` with each. A client that reconnects goes on where it was."""
    start = int(last_event_id) if last_event_id and last_event_id.isascii() and last_event_id.isdigit() else since
    async for event in events.ends(webhooks, min(start, 2**62), request):
        yield event


@router.post(
    "/v1/webhooks",
    status_code=201,
    dependencies=[Depends(may_submit)],
    responses=responses(400, 401, 403, 409, 413, 422, 503),
)
def add_webhook(body: WebhookRequest, response: Response, webhooks: WebhooksOf) -> CreatedWebhook:
    """Tell an address when jobs and datasets of the key's project end. The answer holds its secret, this once."""
    hook, secret = webhooks.add(body.url, body.states)
    response.headers["Location"] = f"/v1/webhooks/{hook.id}/deliveries"
    return CreatedWebhook(**hook.model_dump(), secret=secret)


@router.get("/v1/webhooks", dependencies=[Depends(may_submit)], responses=responses(401, 403, 503))
def list_webhooks(webhooks: WebhooksOf) -> list[WebhookView]:
    """Webhooks that the key may change, without their secrets."""
    return webhooks.all()


@router.get(
    "/v1/webhooks/{webhook_id}/deliveries",
    dependencies=[Depends(may_submit)],
    responses=responses(401, 403, 404, 422, 503),
)
def list_deliveries(webhook_id: WebhookId, webhooks: WebhooksOf, limit: Limit = 50) -> list[DeliveryView]:
    """What became of telling it, the newest first; kept for 30 days."""
    return webhooks.log(webhook_id, limit=limit)


@router.delete(
    "/v1/webhooks/{webhook_id}",
    status_code=204,
    dependencies=[Depends(may_submit)],
    responses=responses(401, 403, 404, 503),
)
def delete_webhook(webhook_id: WebhookId, webhooks: WebhooksOf) -> None:
    """Tell it nothing any more."""
    webhooks.delete(webhook_id)
