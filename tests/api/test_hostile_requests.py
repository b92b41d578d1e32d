"""Requests of odd bytes on sockets of real servers with a real Redis: where every part answers, no answer is a 5xx.

The long run: `pytest -m slow tests/api/test_hostile_requests.py`.
"""

from __future__ import annotations

import random
import re
import socket
import threading
from collections import Counter
from collections.abc import Callable, Iterator

import pytest
import uvicorn
from pydantic import SecretStr

from graspd.api.access.keys import KeyFile, Scope
from graspd.api.app import create_app
from graspd.api.server import bind, configuration
from graspd.service.pipeline.backends import Services
from graspd.service.queue.rq_queue import RqQueue
from graspd.service.settings import Settings
from tests.api.factories import add_job, finish_all
from tests.waiting import PATIENCE_S

_METHODS = (b"GET", b"GET", b"GET", b"POST", b"POST", b"HEAD", b"PUT", b"PATCH", b"DELETE", b"OPTIONS", b"TRACE", b"X")
_PATHS = (
    b"/",
    b"/v1/jobs",
    b"/v1/jobs/JOB",
    b"/v1/jobs/JOB/cancel",
    b"/v1/shards/SHARD/file",
    b"/v1/grasps",
    b"/v1/hands",
    b"/v1/hands/allegro",
    b"/v1/hands/allegro/model",
    b"/v1/objects",
    b"/v1/datasets",
    b"/v1/datasets/estimate",
    b"/v1/tags",
    b"/v1/events",
    b"/v1/usage",
    b"/v1/stats",
    b"/v1/object-sets",
    b"/v1/webhooks",
    b"/healthz",
    b"/metrics",
    b"/login",
    b"/logout",
    b"/submit",
    b"/jobs/JOB",
    b"/grasps",
    b"/hands/allegro",
    b"/usage",
    b"/events",
    b"/static/style.css",
    b"/openapi.json",
    b"/problems/x",
    b"//evil.example/x",
    b"*",
    b"/v1/jobs/",
)
_TAILS = (
    b"",
    b"/",
    b"//",
    b"/%00",
    b"/%ff%fe",
    b"/..%2f..",
    b"/%0d%0aX:1",
    b";a=b",
    b"/" + b"9" * 300,
    b"/\\",
    b"/%u0041",
)
_KEYS = (
    b"limit",
    b"cursor",
    b"since",
    b"until",
    b"state",
    b"where",
    b"sort",
    b"hand",
    b"tag",
    b"format",
    b"views",
    b"x",
)
_WORDS = (
    b"",
    b"0",
    b"-1",
    b"1e400",
    b"NaN",
    b"9" * 400,
    b"%00",
    b"%ff",
    b"%",
    b"%zz",
    b"[",
    b"[[" * 400,
    b"a" * 3000,
    b"null",
    b"true",
    b"'",
    b'"',
    b"1_0",
    b"\xff\xfe",
    b"%F0%9F%A4%96",
    b"2026-01-31",
    b"../../etc/passwd",
    b"${x}",
    b"epsilon > 1e999",
)
_NAMES = (
    b"Host",
    b"Origin",
    b"Referer",
    b"Cookie",
    b"Authorization",
    b"Range",
    b"If-Range",
    b"If-None-Match",
    b"If-Match",
    b"If-Modified-Since",
    b"Accept",
    b"Accept-Encoding",
    b"Accept-Language",
    b"Content-Type",
    b"Content-Length",
    b"Content-Encoding",
    b"Transfer-Encoding",
    b"Expect",
    b"Upgrade",
    b"Forwarded",
    b"X-Forwarded-For",
    b"Via",
    b"X-Forwarded-Host",
    b"X-Forwarded-Proto",
    b"X-Forwarded-Groups",
    b"Idempotency-Key",
    b"Last-Event-ID",
    b"Te",
    b"X-Request-Id",
    b"traceparent",
    b"Sec-Fetch-Site",
    b"HX-Request",
    b"User-Agent",
)
_VALUES = (
    b"",
    b"*",
    b"null",
    b"http://[",
    b"http://[::1",
    b"//[",
    b"[",
    b"[::1]:x",
    b"http://a:99999",
    b"http://a:b",
    b"-1",
    b"\xff\xfe",
    b"9" * 5000,
    b"0x10",
    b"bytes=",
    b"bytes=9-1",
    b"bytes=0-" + b"9" * 400,
    b"bytes=0-0,1-1",
    b'W/"',
    b'"' * 400,
    b"Thu, 99 Foo 9999 99:99:99 GMT",
    b"Bearer",
    b"Bearer \xa0",
    b"Basic !!!",
    b"Basic " + b"QQ==" * 500,
    b"graspd_session=\xff; =; ;;=",
    b"graspd_session=W10=." + b"0" * 64,
    b"application/json; charset=nonsense",
    b"100-continue",
    b"multipart/form-data",
    b"multipart/form-data; boundary=",
    b"multipart/form-data; boundary=b",
    b"text/html;q=\xb2",
    b"application/x-www-form-urlencoded",
    b"gzip, br",
    b'for="[::1";by=',
    b"1.2.3.4, , \xe9",
    b"chunked",
    b"h2c",
    b"cross-site",
    b"<script>",
    b"00-" + b"0" * 60,
    b"../../x",
    b"{}",
    b"\x7f",
    b"text/html",
)
_BODIES = (
    b"",
    b"{}",
    b"[",
    b"[" * 50_000,
    b"\xff" * 50,
    b'{"hand": "allegro", "object": "mug", "grasps": 32}',
    b'{"hand": "\\ud800"}',
    b'{"name": "d", "hands": ["allegro"], "objects": ["mug"], "grasps": 1e400}',
    b"key=%ff&key=gd_",
    b"a=b&" * 2000,
    b'{"url": "http://[", "states": ["failed"]}',
    b'{"url": "https://a.example/\\u0000"}',
    b'{"name": "t", "where": "((((((("}',
    b'--b\r\nContent-Disposition: form-data; name="file"; filename="..\\..\\\xff.stl"\r\n\r\nsolid\r\n--b--\r\n',
    b'--b\r\nContent-Disposition: form-data; name="file"; filename="a.zip"\r\n\r\nPK\x03\x04\r\n--b--\r\n',
    b"--b\r\nContent-Disposition: nonsense\r\n\r\n",
)

#: One that stands alone is the last, and true.
_LENGTHS = re.compile(rb"\r\n(?:Content-Length|Transfer-Encoding): ")
Ask = Callable[[bytes], int]


@pytest.fixture
def ask(settings: Settings, services: Services, redis_server: str, rq_queue: RqQueue) -> Iterator[Ask]:
    """Sends bytes to an open service or to one with keys, and gives the status of the answer; 0: there is none."""
    record = add_job(services)
    finish_all(services, record)
    shard = services.index.shards.page(job=record.id).items[0].id
    limits = dict.fromkeys(("requests_per_minute", "address_requests_per_minute", "concurrency"), 0)
    base = settings.model_copy(update={"redis_url": SecretStr(redis_server), **limits})
    closed = base.model_copy(update={"keys_file": settings.data_dir / "other-keys.json"})
    key = KeyFile(closed.resolved_keys_file).add("k", Scope.ADMIN).encode()
    running = []
    for one in (base, closed):
        app = create_app(one, Services(one, services.store, services.index, services.queue))
        server, listener = uvicorn.Server(configuration(app, one)), bind("127.0.0.1", 0)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        running.append((server, thread, listener.getsockname()))

    def send(request: bytes) -> int:
        filled = request.replace(b"JOB", record.id.encode()).replace(b"SHARD", shard.encode()).replace(b"KEY", key)
        place = running[len(request) % 2][2]
        with socket.create_connection(place, timeout=PATIENCE_S) as connection:
            answer = b""
            try:
                connection.sendall(filled)
                if len(_LENGTHS.findall(request)) != 1:
                    # The server may wait for more than there is. To one that waits for nothing this is the end as well.
                    connection.shutdown(socket.SHUT_WR)
                while b"\r\n" not in answer and (piece := connection.recv(4096)):
                    answer += piece
            except ConnectionError:
                pass  # what was sent was not read to its end
        line = answer.partition(b"\r\n")[0].split()
        return int(line[1]) if len(line) > 1 else 0

    yield send
    for server, thread, _ in running:
        server.should_exit = True
        thread.join(PATIENCE_S)


def walk(ask: Ask, requests: int, seed: int) -> Counter[int]:
    """How often each status came; fails with the requests that made a 5xx."""
    chance, found, wrong = random.Random(seed), Counter[int](), []
    for _ in range(requests):
        request = _request(chance)
        status = ask(request)
        found[status] += 1
        if status >= 500:
            wrong.append((status, request))
    assert not wrong, wrong[:3]
    return found


def _request(chance: random.Random) -> bytes:
    path = chance.choice(_PATHS) + (chance.choice(_TAILS) if chance.random() < 0.2 else b"")
    query = b"&".join(chance.choice(_KEYS) + b"=" + chance.choice(_WORDS) for _ in range(chance.choice((0, 0, 1, 3))))
    headers = [
        (b"Host", b"127.0.0.1"),
        (b"Authorization", b"Bearer KEY"),
        (b"Accept", chance.choice((b"text/html", b"*/*"))),
    ]
    for name in chance.sample(_NAMES, chance.choice((0, 1, 2, 4))):
        headers = [one for one in headers if one[0] != name or chance.random() < 0.2]
        headers.append((name, chance.choice(_VALUES)))
    method, body = chance.choice(_METHODS), chance.choice(_BODIES) if chance.random() < 0.5 else b""
    headers.append((b"Content-Length", b"%d" % len(body)))
    if method in (b"POST", b"PUT") and chance.random() < 0.7:
        kind = b"multipart/form-data; boundary=b" if body.startswith(b"--b") else b"application/json"
        headers.append((b"Content-Type", kind))
    lines = b"".join(name + b": " + value + b"\r\n" for name, value in [*headers, (b"Connection", b"close")])
    return method + b" " + path + (b"?" + query if query else b"") + b" HTTP/1.1\r\n" + lines + b"\r\n" + body


def test_no_bytes_end_in_a_5xx(ask: Ask) -> None:
    found = walk(ask, 1500, seed=1)
    # The walk meets what it is to meet: answers, refusals, and things that are not there.
    assert found[200] > 100 and {400, 401, 403, 404, 405, 422} <= set(found)


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_no_bytes_of_fifty_thousand_requests_end_in_a_5xx(ask: Ask) -> None:
    print(dict(walk(ask, 50_000, seed=2)))
