"""Server-sent events, until the key is invalid; feed of ended jobs and datasets; webhooks."""

from __future__ import annotations

import asyncio
import logging
import secrets
from collections.abc import AsyncIterator
from functools import partial
from typing import Final

from anyio.to_thread import run_sync
from fastapi import Request
from fastapi.sse import ServerSentEvent

from graspd.api.access import auth
from graspd.api.access.keys import Scope
from graspd.api.catalog.jobs import Jobs
from graspd.api.catalog.overview import Overview
from graspd.service.index.views import DeliveryView, EndView, WebhookView
from graspd.service.model import names
from graspd.service.model.clock import timestamp
from graspd.service.model.digests import digest_json
from graspd.service.model.errors import ConflictError, LimitError, UnavailableError
from graspd.service.model.projects import ProjectScope
from graspd.service.model.webhooks import MOST_HOOKS, End, Webhook, check_url, derive_secret
from graspd.service.pipeline.backends import Services, record_transaction

log = logging.getLogger(__name__)
POLL_S: Final = 0.5
RETRY_MS: Final = 2000
_ENDS_AT_ONCE: Final = 100


async def job_events(jobs: Jobs, job_id: str, request: Request) -> AsyncIterator[ServerSentEvent]:
    """Send `progress` with the job at each change, and `end` when its state is final."""
    last = ""
    while not await request.is_disconnected() and auth.is_still_authorized(request, Scope.READ):
        try:
            job = await run_sync(jobs.get_progress, job_id)
        except UnavailableError as error:
            yield ServerSentEvent(event="unavailable", data={"detail": str(error)}, retry=RETRY_MS)
            await asyncio.sleep(RETRY_MS / 1000)
            continue
        document = job.model_dump(mode="json")
        digest = digest_json({"state": job.state, "stages": [[s.done, s.running, s.message] for s in job.stages]})
        if digest != last:
            last = digest
            yield ServerSentEvent(event="progress", data=document, id=digest, retry=RETRY_MS)
        if job.state.is_final:
            yield ServerSentEvent(event="end", data=document, id=digest)
            return
        await asyncio.sleep(POLL_S)


async def end_events(webhooks: Webhooks, since: int, request: Request) -> AsyncIterator[ServerSentEvent]:
    """Send `end` for each job or dataset that ended after number `since`."""
    while not await request.is_disconnected() and auth.is_still_authorized(request, Scope.READ):
        try:
            found = await run_sync(partial(webhooks.end_events, since, limit=_ENDS_AT_ONCE))
        except UnavailableError as error:
            yield ServerSentEvent(event="unavailable", data={"detail": str(error)}, retry=RETRY_MS)
            await asyncio.sleep(RETRY_MS / 1000)
            continue
        for end in found:
            since = end.seq
            yield ServerSentEvent(event="end", data=end.model_dump(mode="json"), id=str(end.seq), retry=RETRY_MS)
        if not found:
            await asyncio.sleep(2 * POLL_S)


async def service_events(overview: Overview, request: Request) -> AsyncIterator[ServerSentEvent]:
    """Send `progress` without content when a job, task or worker changed."""
    last = ""
    while not await request.is_disconnected() and auth.is_still_authorized(request, Scope.READ):
        try:
            digest = await run_sync(overview.fingerprint)
        except UnavailableError as error:
            digest = str(error)
        if digest != last:
            last = digest
            yield ServerSentEvent(event="progress", data={}, retry=RETRY_MS)
        await asyncio.sleep(2 * POLL_S)


class Webhooks:
    def __init__(self, services: Services) -> None:
        self._services = services

    end_events = auth.InScope(lambda index: index.outbox.end_events)

    def own_ends(self, since: int, *, limit: int) -> list[tuple[EndView, str]]:
        return self._services.index.outbox.own_ends(auth.caller_id(), since, limit=limit, scope=auth.project_scope())

    def add(self, url: str, states: tuple[End, ...]) -> tuple[WebhookView, str]:
        """Add a webhook; return it with its secret, which cannot be shown again."""
        master = self._services.settings.webhook_secret
        if master is None:
            raise ConflictError("webhooks are off; the operator can set GRASPD_WEBHOOK_SECRET for API and controller")
        project, states = auth.project_scope().project, tuple(dict.fromkeys(states))
        about = {"created": timestamp(), "owner": auth.caller_id(), "project": project}
        hook = Webhook(id=secrets.token_hex(16), url=check_url(url), states=states, **about)
        with record_transaction(self._services) as (connection, put):
            if len(self._services.index.outbox.webhooks(scope=ProjectScope(project, everything=False))) >= MOST_HOOKS:
                raise LimitError(f"there are {MOST_HOOKS} webhooks already, the maximum; delete one")
            put(names.webhook_key(hook.id), hook)
            self._services.index.outbox.add(hook, within=connection)
        key = auth.caller.get()
        log.info("webhook %s made by %s", hook.id, key.name if key else "this machine")
        return self._services.index.outbox.webhook(hook.id), derive_secret(master.get_secret_value(), hook.id)

    def all(self) -> list[WebhookView]:
        """Return only webhooks that the caller may change, because their addresses may contain credentials."""
        hooks = self._services.index.outbox.webhooks(scope=auth.project_scope())
        return [hook for hook in hooks if auth.may_change(hook.owner, hook.project)]

    def deliveries(self, webhook: str, *, limit: int = 50) -> list[DeliveryView]:
        return self._services.index.outbox.delivery_log(self._get_owned(webhook).id, limit=limit)

    def delete(self, webhook: str) -> None:
        hook = self._get_owned(webhook)
        # The record goes first: an interrupted deletion then leaves only a row, which a rebuild drops.
        self._services.store.delete(names.webhook_key(hook.id))
        self._services.index.outbox.remove(hook.id)
        log.info("webhook %s deleted", hook.id)

    def _get_owned(self, webhook: str) -> WebhookView:
        hook = self._services.index.outbox.webhook(webhook, scope=auth.project_scope())
        auth.require_ownership(hook.owner, f"webhook {webhook}", hook.project)
        return hook
