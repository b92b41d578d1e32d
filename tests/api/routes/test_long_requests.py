"""Uploads take turns in threads of their own: they keep nobody else waiting, and no more wait than a bound."""

from __future__ import annotations

import asyncio
import threading

import httpx
import pytest
from fastapi import FastAPI

from graspd.api.routes import assets
from graspd.api.routes.dependencies import RequestLimiter
from graspd.service.model.errors import UnavailableError
from tests.waiting import PATIENCE_S


def test_sixty_long_uploads_keep_no_other_request_waiting(app: FastAPI, monkeypatch: pytest.MonkeyPatch) -> None:
    hold = threading.Event()
    inside = threading.Semaphore(0)

    def takes_long(*_: object, **__: object) -> dict[str, bytes]:
        inside.release()
        hold.wait(PATIENCE_S)
        raise UnavailableError("it took too long")

    monkeypatch.setattr(assets, "files_of_upload", takes_long)

    async def use() -> tuple[list[int], list[httpx.Response]]:
        transport = httpx.ASGITransport(app=app)
        async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1:8000", timeout=60) as client:
            files = {"file": ("bomb.zip", b"PK")}
            uploads = [asyncio.create_task(client.post("/v1/objects", files=files)) for _ in range(60)]
            await asyncio.to_thread(inside.acquire)
            try:
                async with asyncio.timeout(PATIENCE_S):
                    # What is over the bound is refused at once; only then is everybody else where they wait.
                    while sum(task.done() for task in uploads) < 24:
                        await asyncio.sleep(0.01)
                    others = [(await client.get(path)).status_code for path in ("/healthz", "/v1/objects")]
            finally:
                hold.set()
            return others, list(await asyncio.gather(*uploads))

    others, answers = asyncio.run(use())
    assert others == [200, 200]
    assert {(answer.status_code, "retry-after" in answer.headers) for answer in answers} == {(503, True)}


def test_a_turn_that_does_not_come_in_time_is_refused() -> None:
    async def use() -> None:
        turns = RequestLimiter(1, patience_s=0.05)
        hold = threading.Event()
        first = asyncio.create_task(turns.run(hold.wait, PATIENCE_S))
        await asyncio.sleep(0)
        try:
            with pytest.raises(UnavailableError):
                await turns.run(int)
        finally:
            hold.set()
        await first
        assert await turns.run(int, "7") == 7

    asyncio.run(use())
