"""Server-sent events: a stream that says when a job, or anything, has changed. It ends when
its key does."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import AsyncIterator
from typing import Final
from weakref import WeakKeyDictionary

from anyio.to_thread import run_sync
from fastapi import Request
from fastapi.sse import ServerSentEvent

from api.access.auth import may_still
from api.access.keys import Scope
from api.catalog.catalog import Catalog
from service.model.digests import digest_json
from service.model.errors import UnavailableError

POLL_S: Final = 0.5
#: A client that reconnects waits this long.
RETRY_MS: Final = 2000


async def job_events(catalog: Catalog, job_id: str, request: Request) -> AsyncIterator[ServerSentEvent]:
    """`progress` with the job whenever it changed; `end` when its state is final."""
    last = ""
    while not await request.is_disconnected() and may_still(request, Scope.READ):
        try:
            job = await run_sync(catalog.job_state, job_id)
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


async def service_events(catalog: Catalog, request: Request) -> AsyncIterator[ServerSentEvent]:
    """`progress` without content whenever a job, a task or a worker changed: the home page looks again."""
    last = ""
    while not await request.is_disconnected() and may_still(request, Scope.READ):
        try:
            digest = await run_sync(_seen.of, catalog)
        except UnavailableError as error:
            digest = str(error)
        if digest != last:
            last = digest
            yield ServerSentEvent(event="progress", data={}, retry=RETRY_MS)
        await asyncio.sleep(2 * POLL_S)


class _Fingerprints:
    """What the service looks like, asked anew at most once a pause however many pages are open."""

    def __init__(self) -> None:
        self._known: WeakKeyDictionary[Catalog, tuple[float, str]] = WeakKeyDictionary()
        self._lock = threading.Lock()

    def of(self, catalog: Catalog) -> str:
        with self._lock:
            at, digest = self._known.get(catalog, (0.0, ""))
            now = time.monotonic()
            if not digest or now - at >= 2 * POLL_S:
                digest = _fingerprint(catalog)
                self._known[catalog] = (now, digest)
            return digest


_seen: Final = _Fingerprints()


def _fingerprint(catalog: Catalog) -> str:
    jobs = catalog.jobs(limit=20).items
    workers = [(worker.name, worker.state, worker.task_id) for worker in catalog.workers()]
    moving = [(job.id, job.state, round(job.progress, 3)) for job in jobs]
    return digest_json({"stats": catalog.stats().model_dump(mode="json"), "workers": workers, "jobs": moving})
