"""Headers that a stranger may send, odd ones and broken ones: none of them ends in a 5xx.

The long run: `pytest -m slow tests/api/test_hostile_headers.py`.
"""

from __future__ import annotations

import asyncio
import random
from collections import Counter
from collections.abc import Iterator
from typing import Any

import pytest

from graspd.api.access.keys import KeyFile, Scope
from graspd.api.app import create_app
from graspd.service.pipeline.backends import Services
from graspd.service.settings import Settings
from tests.api.factories import add_job, finish_all

_NAMES = [
    "host",
    "origin",
    "referer",
    "cookie",
    "authorization",
    "range",
    "if-none-match",
    "if-modified-since",
    "if-match",
    "if-range",
    "accept",
    "accept-encoding",
    "accept-language",
    "content-length",
    "content-type",
    "content-encoding",
    "transfer-encoding",
    "expect",
    "connection",
    "upgrade",
    "forwarded",
    "x-forwarded-for",
    "x-forwarded-host",
    "x-forwarded-proto",
    "x-forwarded-user",
    "x-real-ip",
    "via",
    "idempotency-key",
    "last-event-id",
    "x-request-id",
    "traceparent",
    "tracestate",
    "sec-fetch-site",
    "x-http-method-override",
    "hx-request",
    "hx-target",
    "user-agent",
]
_VALUES = (
    "",
    " ",
    "*",
    "null",
    "http://[",
    "http://[::1",
    "//[",
    "http://\u00e9",
    "\u00ff\u00fe",
    "http://a:99999/",
    "http://a:b",
    "[",
    "[::1]:x",
    "a" * 8000,
    "9" * 5000,
    "-1",
    "0x10",
    "1e400",
    "NaN",
    "bytes=",
    "bytes=-",
    "bytes=9-1",
    "bytes=0-" + "9" * 400,
    "bytes=a-b",
    "bytes=0-0,1-1," + "2-2," * 200,
    'W/"',
    '"' * 400,
    "W/*",
    "Thu, 99 Foo 9999 99:99:99 GMT",
    "Bearer",
    "Bearer ",
    "Bearer gd_\u00e9",
    "Bearer \u00a0",
    "Basic !!!",
    "Bearer " + "a" * 4000,
    "graspd_session=",
    "graspd_session=\u00ff; a=b; ;;=",
    "a=" + '"\\',
    "=",
    "application/json; charset=nonsense",
    "multipart/form-data",
    "multipart/form-data; boundary=",
    "text/html;q=\u00b2",
    "gzip, br",
    'for="[::1";by=',
    "1.2.3.4, , \u00e9",
    "127.0.0.1:x",
    "%00",
    "\x01",
    "../../etc/passwd",
    "<script>",
    "{}",
    "00-" + "0" * 60,
    "cross-site",
)
_PATHS = [
    "/",
    "/v1/jobs",
    "/v1/jobs/{job}",
    "/v1/jobs/{job}/cancel",
    "/v1/shards/{shard}",
    "/v1/shards/{shard}/file",
    "/v1/grasps",
    "/v1/stats",
    "/v1/hands",
    "/v1/hands/allegro",
    "/v1/objects",
    "/v1/datasets",
    "/v1/webhooks",
    "/v1/tags",
    "/v1/events",
    "/healthz",
    "/readyz",
    "/metrics",
    "/login",
    "/submit",
    "/jobs",
    "/jobs/{job}",
    "/datasets",
    "/grasps",
    "/hands",
    "/workers",
    "/static/app.css",
    "/openapi.json",
    "/v1/hands/allegro/model.glb",
    "/nowhere",
]
_METHODS = ("GET", "GET", "GET", "POST", "HEAD", "DELETE", "PUT", "OPTIONS", "PATCH")


@pytest.fixture
def applications(settings: Settings, services: Services) -> Iterator[tuple[list[Any], str, list[str]]]:
    """An open service and one with keys over the same services; a live key; and the paths, with a job and its shard."""
    record = add_job(services)
    finish_all(services, record)
    shard = services.index.shards.page(job=record.id).items[0].id
    paths = [path.format(job=record.id, shard=shard) for path in _PATHS]
    closed = settings.model_copy(update={"keys_file": settings.data_dir / "other-keys.json"})
    key = KeyFile(closed.resolved_keys_file).add("k", Scope.ADMIN)
    yield [create_app(settings, services), create_app(closed, services)], key, paths


async def ask(app: Any, method: str, path: str, headers: list[tuple[bytes, bytes]], body: bytes) -> int:
    scope = {
        "type": "http",
        "asgi": {"version": "3.0"},
        "http_version": "1.1",
        "method": method,
        "scheme": "http",
        "path": path,
        "raw_path": path.encode(),
        "query_string": b"",
        "root_path": "",
        "headers": headers,
        "client": ("127.0.0.1", 5000),
        "server": ("127.0.0.1", 8000),
        "state": {},
    }
    status, sent = 0, False

    async def receive() -> dict[str, Any]:
        nonlocal sent
        if sent:
            return {"type": "http.disconnect"}
        sent = True
        return {"type": "http.request", "body": body, "more_body": False}

    async def send(message: Any) -> None:
        nonlocal status
        status = message.get("status", status)

    await app(scope, receive, send)
    return status


def walk(applications: tuple[list[Any], str, list[str]], requests: int, seed: int) -> Counter[int]:
    apps, key, paths = applications
    chance, found, wrong = random.Random(seed), Counter[int](), []

    async def run() -> None:
        for _ in range(requests):
            path, method = chance.choice(paths), chance.choice(_METHODS)
            headers = {
                "host": "127.0.0.1",
                "authorization": f"Bearer {key}",
                "accept": chance.choice(("text/html", "*/*")),
            }
            for name in chance.sample(_NAMES, chance.randint(1, 4)):
                headers[name] = chance.choice(_VALUES)
            raw = [(name.encode(), value.encode("latin-1", "replace")) for name, value in headers.items()]
            body = chance.choice(
                (b"", b"{}", b"[", b"\xff" * 50, b'{"hand": "allegro", "object": "mug", "grasps": 32}')
            )
            try:
                status = await ask(chance.choice(apps), method, path, raw, body)
            except Exception as error:
                status = 599
                wrong.append((method, path, headers, repr(error)))
            found[status] += 1
            if 500 <= status < 599 and status != 503:
                wrong.append((method, path, headers, status))

    asyncio.run(run())
    assert not wrong, wrong[:3]
    return found


def test_no_header_ends_in_a_5xx(applications: tuple[list[Any], str, list[str]]) -> None:
    found = walk(applications, 1000, seed=1)
    # The walk meets what it is to meet: answers, refusals, and things that are not there.
    assert found[200] > 100 and {401, 403, 404} <= set(found)


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_no_header_of_fifty_thousand_requests_ends_in_a_5xx(applications: tuple[list[Any], str, list[str]]) -> None:
    print(dict(walk(applications, 50_000, seed=2)))
