"""Server-sent events: a stream that says when a job, or anything, has changed. It ends when
its key does."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from functools import partial
from typing import Final

from anyio.to_thread import run_sync
from fastapi import Request
from fastapi.sse import ServerSentEvent

from api.access.auth import may_still
from api.access.keys import Scope
from api.catalog.jobs import Jobs
from api.catalog.overview import Overview
from api.catalog.webhooks import Webhooks
from service.model.digests import digest_json
from service.model.errors import UnavailableError

POLL_S: Final = 0.5
#: A client that reconnects waits this long.
RETRY_MS: Final = 2000
_ENDS_AT_ONCE: Final = 100


async def job_events(jobs: Jobs, job_id: str, request: Request) -> AsyncIterator[ServerSentEvent]:
    """`progress` with the job whenever it changed; `end` when its state is final."""
    last = ""
    while not await request.is_disconnected() and may_still(request, Scope.READ):
        try:
            job = await run_sync(jobs.moving, job_id)
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


async def ends(webhooks: Webhooks, since: int, request: Request) -> AsyncIterator[ServerSentEvent]:
    """`end` with each job and dataset that ended, in this order."""
    while not await request.is_disconnected() and may_still(request, Scope.READ):
        try:
            found = await run_sync(partial(webhooks.ends, since, limit=_ENDS_AT_ONCE))
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
    """`progress` without content whenever a job, a task or a worker changed: the home page looks again."""
    last = ""
    while not await request.is_disconnected() and may_still(request, Scope.READ):
        try:
            digest = await run_sync(overview.fingerprint)
        except UnavailableError as error:
            digest = str(error)
        if digest != last:
            last = digest
            yield ServerSentEvent(event="progress", data={}, retry=RETRY_MS)
        await asyncio.sleep(2 * POLL_S)
