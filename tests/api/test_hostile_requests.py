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

_METHODS = "GET GET GET POST POST HEAD PUT PATCH DELETE OPTIONS TRACE X"

_NAMES = """
    host origin referer cookie authorization range if-range if-none-match if-match if-modified-since accept
    accept-encoding accept-language content-type content-length content-encoding transfer-encoding expect connection
    upgrade forwarded via te x-forwarded-for x-forwarded-host x-forwarded-proto x-forwarded-groups x-forwarded-user
    x-real-ip idempotency-key last-event-id x-request-id traceparent tracestate sec-fetch-site x-http-method-override
    hx-request hx-target user-agent
"""

#: With {job} and {shard}.
_PATHS = """
    / /v1/jobs /v1/jobs/ /v1/jobs/{job} /v1/jobs/{job}/cancel /v1/shards/{shard} /v1/shards/{shard}/file /v1/grasps
    /v1/stats /v1/hands /v1/hands/allegro /v1/hands/allegro/model /v1/hands/allegro/model.glb /v1/objects /v1/datasets
    /v1/datasets/estimate /v1/webhooks /v1/tags /v1/events /v1/usage /v1/object-sets /healthz /readyz /metrics /login
    /logout /submit /jobs /jobs/{job} /datasets /grasps /hands /hands/allegro /workers /usage /events
    /static/style.css /static/app.css /openapi.json /problems/x /nowhere //evil.example/x *
"""

_VALUES = (
    "| |*|null|http://[|http://[::1|//[|[|[::1]:x|http://\xe9|\xff\xfe|http://a:99999/|http://a:b|-1|0x10|1e400|NaN|"
    'bytes=|bytes=-|bytes=9-1|bytes=a-b|bytes=0-0,1-1|W/"|W/*|Thu, 99 Foo 9999 99:99:99 GMT|Bearer|Bearer |Bearer \xa0|'
    'Bearer gd_\xe9|Basic !!!|graspd_session=|graspd_session=\xff; a=b; ;;=|a="\\|=|application/json; charset=nonsense|'
    "100-continue|multipart/form-data|multipart/form-data; boundary=|multipart/form-data; boundary=b|text/html|"
    'text/html;q=\xb2|application/x-www-form-urlencoded|gzip, br|for="[::1";by=|1.2.3.4, , \xe9|127.0.0.1:x|chunked|'
    "h2c|cross-site|%00|\x01|\x7f|../../etc/passwd|../../x|<script>|{}"
)
_LONG = ("a" * 8000, "9" * 5000, '"' * 400, "bytes=0-" + "9" * 400, "bytes=0-0,1-1," + "2-2," * 200, "00-" + "0" * 60)
_LONG_KEYS = ("Bearer " + "a" * 4000, "Basic " + "QQ==" * 500, "graspd_session=W10=." + "0" * 64)

METHODS, NAMES, PATHS = _METHODS.split(), _NAMES.split(), _PATHS.split()
VALUES = [*_VALUES.split("|"), *_LONG, *_LONG_KEYS]
#: Sent first, one each, for what the server itself reads of a request.
_PAIRS = [(name, value) for name in ("origin", "host", "cookie", "authorization", "range") for value in VALUES]
JOB_BODY = b'{"hand": "allegro", "object": "mug", "grasps": 32}'
_QUERY_KEYS = "limit cursor since until state where sort hand tag format views x"
_KEYS = _QUERY_KEYS.encode().split()
_TAILS = (*b"|/|//|/%00|/%ff%fe|/..%2f..|/%0d%0aX:1|;a=b|/\\|/%u0041".split(b"|"), b"/" + b"9" * 300)
_ODD = b"|0|-1|1e400|NaN|%00|%ff|%|%zz|[|null|true|'|\"|1_0|\xff\xfe|%F0%9F%A4%96|2026-01-31|../../etc/passwd|${x}"
_WORDS = (*_ODD.split(b"|"), b"9" * 400, b"[[" * 400, b"a" * 3000, b"epsilon > 1e999")
#: Without a controller a service is not ready, and says so.
_ASKED = [path for path in PATHS if path != "/readyz"]
_BODIES = (
    *(b"", b"{}", b"[", b"[" * 50_000, b"\xff" * 50, JOB_BODY),
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
_LENGTHS = re.compile(rb"\r\n(?i:content-length|transfer-encoding): ")
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
        filled = request.replace(b"{job}", record.id.encode()).replace(b"{shard}", shard.encode()).replace(b"KEY", key)
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
    for number in range(requests):
        request = _request(chance, _PAIRS[number : number + 1])
        status = ask(request)
        found[status] += 1
        if status >= 500:
            wrong.append((status, request))
    assert not wrong, wrong[:3]
    return found


def _request(chance: random.Random, odd: list[tuple[str, str]]) -> bytes:
    path = chance.choice(_ASKED).encode() + (chance.choice(_TAILS) if chance.random() < 0.2 else b"")
    query = b"&".join(chance.choice(_KEYS) + b"=" + chance.choice(_WORDS) for _ in range(chance.choice((0, 0, 1, 3))))
    headers = [(b"Host", b"127.0.0.1"), (b"Authorization", b"Bearer KEY")]
    headers.append((b"Accept", chance.choice((b"text/html", b"*/*"))))
    for name, value in odd or [
        (name, chance.choice(VALUES)) for name in chance.sample(NAMES, chance.choice((0, 1, 2, 4)))
    ]:
        headers = [one for one in headers if one[0].lower() != name.encode() or chance.random() < 0.2]
        headers.append((name.encode(), value.encode("latin-1")))
    method, body = chance.choice(METHODS).encode(), chance.choice(_BODIES) if chance.random() < 0.5 else b""
    headers.append((b"Content-Length", b"%d" % len(body)))
    if method in (b"POST", b"PUT") and chance.random() < 0.7:
        kind = b"multipart/form-data; boundary=b" if body.startswith(b"--b") else b"application/json"
        headers.append((b"Content-Type", kind))
    lines = b"".join(name + b": " + value + b"\r\n" for name, value in [*headers, (b"Connection", b"close")])
    return method + b" " + path + (b"?" + query if query else b"") + b" HTTP/1.1\r\n" + lines + b"\r\n" + body


def test_no_bytes_end_in_a_5xx(ask: Ask) -> None:
    found = walk(ask, 800, seed=1)
    # The walk meets what it is to meet: answers, refusals, and things that are not there.
    assert found[200] > 50 and {400, 401, 403, 404, 405, 422} <= set(found)


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_no_bytes_of_fifty_thousand_requests_end_in_a_5xx(ask: Ask) -> None:
    print(dict(walk(ask, 50_000, seed=2)))
