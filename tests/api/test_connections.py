"""Connections to a real server on loopback: half-sent headers, bodies, forwarded addresses, streams of events."""

import asyncio
import socket
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import uvicorn
from fastapi import FastAPI, Request

from graspd.api.access.keys import KeyFile, Scope
from graspd.api.app import create_app
from graspd.api.catalog import events
from graspd.api.server import TimedProtocol, configuration
from graspd.service.pipeline.backends import Services
from graspd.service.run.address import bind_socket
from graspd.service.settings import Settings
from tests.api.factories import add_job
from tests.waiting import PATIENCE_S, until

Connect = Callable[..., socket.socket]
Closed = tuple[FastAPI, dict[Scope, str]]
_WHOLE = b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
_HALF = b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Half: "
_POST = b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: %d\r\n\r\n"


class _Quick(TimedProtocol):
    headers_s = 0.3
    rest_s = 0.2


async def tells_its_client(scope: Any, receive: Any, send: Any) -> None:
    """Answers with the address it sees, after longer than headers may take."""
    if scope["type"] != "http":
        return
    await asyncio.sleep(2 * _Quick.headers_s)
    body = scope["client"][0].encode()
    await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"%d" % len(body))]})
    await send({"type": "http.response.body", "body": body})


@pytest.fixture
def connect(settings: Settings) -> Iterator[Connect]:
    """Opens connections to an application, each served as `graspd api` does but for a shorter patience; what is `sent`
    is there before the server looks, however busy the machine is."""
    running: list[tuple[uvicorn.Server, threading.Thread]] = []
    opened: list[socket.socket] = []

    def start(sent: bytes = b"", *, app: Any = tells_its_client) -> socket.socket:
        config = configuration(app, settings)
        assert config.http is TimedProtocol
        config.http = _Quick
        listener = bind_socket("127.0.0.1", 0)
        listener.listen()
        connection = socket.create_connection(listener.getsockname(), timeout=PATIENCE_S)
        opened.append(connection)
        connection.sendall(sent)
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        running.append((server, thread))
        return connection

    yield start
    for connection in opened:
        connection.close()
    for server, thread in running:
        server.should_exit = True
        thread.join(PATIENCE_S)


def rest(connection: socket.socket) -> bytes:
    found = b""
    while piece := connection.recv(65536):
        found += piece
    return found


def test_half_sent_headers_are_given_up(connect: Connect) -> None:
    assert rest(connect()) == b""
    assert rest(connect(_HALF)).startswith(b"HTTP/1.1 408 ")
    answer = rest(connect(_WHOLE + _HALF))
    assert answer.index(b" 200 ") < answer.index(b" 408 ")
    later = connect(_WHOLE)
    assert b" 200 " in later.recv(65536)
    later.sendall(_HALF)
    assert b" 408 " in rest(later)


def test_headers_that_trickle_in_win_no_time(connect: Connect) -> None:
    connection = connect(_HALF)
    answer = b""
    connection.settimeout(0.02)

    def trickle() -> bool:
        nonlocal answer
        try:
            answer = connection.recv(100)
        except TimeoutError:
            connection.sendall(b"a")
        return bool(answer)

    until(trickle, "the server gives up")
    assert answer.startswith(b"HTTP/1.1 408 ")


def test_a_request_of_two_lengths_is_refused(connect: Connect, app: FastAPI) -> None:
    lengths = b"Transfer-Encoding: chunked\r\nContent-Length: 5\r\n"
    sent = b"POST /v1/jobs HTTP/1.1\r\nHost: 127.0.0.1\r\n" + lengths + b"\r\n0\r\n\r\nGET /healthz HTTP/1.1\r\n"
    answer = rest(connect(sent, app=app))
    assert answer.startswith(b"HTTP/1.1 400 ") and answer.count(b"HTTP/1.1") == 1


@pytest.mark.parametrize(("believed", "seen"), [("", b"127.0.0.1"), ("127.0.0.1", b"192.0.2.7")])
def test_a_forwarded_address_is_believed_only_where_allowed(
    connect: Connect, monkeypatch: pytest.MonkeyPatch, believed: str, seen: bytes
) -> None:
    monkeypatch.delenv("FORWARDED_ALLOW_IPS", raising=False)
    if believed:
        monkeypatch.setenv("FORWARDED_ALLOW_IPS", believed)
    forwarded = b"X-Forwarded-For: 192.0.2.7\r\nConnection: close\r\n\r\n"
    assert rest(connect(_WHOLE.removesuffix(b"\r\n") + forwarded)).endswith(b"\r\n\r\n" + seen)


def test_head_of_a_stream_that_never_ends_does(app: FastAPI, connect: Connect) -> None:
    connection = connect(b"HEAD /events HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\n\r\n", app=app)
    head, _, body = rest(connection).partition(b"\r\n\r\n")
    assert head.startswith(b"HTTP/1.1 200")
    assert body == b""


@pytest.mark.parametrize("end", ["revoked", "a first key"])
@pytest.mark.parametrize("what", ["job", "service"])
def test_a_stream_of_events_ends_with_its_key(app: FastAPI, services: Services, what: str, end: str) -> None:
    keys: KeyFile = app.state.keys
    headers = []
    if end == "revoked":
        headers = [(b"authorization", f"Bearer {keys.add('me', Scope.READ)}".encode())]
    job = add_job(services).id

    async def nothing() -> dict[str, Any]:
        await asyncio.sleep(2 * PATIENCE_S)
        return {"type": "http.disconnect"}

    async def watch() -> None:
        request = Request({"type": "http", "app": app, "headers": headers, "state": {}}, nothing)
        if what == "job":
            stream = events.job_events(app.state.jobs, job, request)
        else:
            stream = events.service_events(app.state.overview, request)
        async with asyncio.timeout(PATIENCE_S):
            await anext(stream)
            if end == "revoked":
                keys.revoke("me")
            else:
                keys.add("me", Scope.READ)
            with pytest.raises(StopAsyncIteration):
                await anext(stream)

    asyncio.run(watch())


@pytest.fixture
def closed(settings: Settings, services: Services, keys: KeyFile) -> Closed:
    made = {scope: keys.add(scope.value, scope) for scope in Scope}
    return create_app(settings, services), made


def upload(length: int, *more: bytes, path: bytes = b"/v1/objects") -> bytes:
    lines = [b"POST %s HTTP/1.1" % path, b"Host: 127.0.0.1", b"Content-Type: multipart/form-data; boundary=b", *more]
    return b"\r\n".join([*lines, b"Content-Length: %d" % length, b"", b""])


@pytest.mark.parametrize("path", [b"/v1/objects", b"/v1/hands", b"/v1/networks", b"/submit", b"/v1/jobs"])
def test_a_body_without_a_key_is_refused_before_it_is_sent(path: bytes, connect: Connect, closed: Closed) -> None:
    length = 900_000 if path == b"/v1/jobs" else 40_000_000
    connection = connect(upload(length, b"Expect: 100-continue", path=path), app=closed[0])
    assert rest(connection).startswith(b"HTTP/1.1 401 ")


def test_a_key_that_may_not_upload_is_refused_before_the_body(connect: Connect, closed: Closed) -> None:
    key = b"Authorization: Bearer " + closed[1][Scope.READ].encode()
    assert rest(connect(upload(40_000_000, key), app=closed[0])).startswith(b"HTTP/1.1 403 ")


def test_uploads_without_a_key_leave_nothing(connect: Connect, closed: Closed, monkeypatch: pytest.MonkeyPatch) -> None:
    spooled: list[Any] = []
    monkeypatch.setattr("starlette.formparsers.SpooledTemporaryFile", lambda *_, **__: spooled.append(1))
    part = b'--b\r\nContent-Disposition: form-data; name="file"; filename="m.stl"\r\n\r\n'
    first = connect(upload(40_000_000) + part, app=closed[0])
    others = [socket.create_connection(first.getpeername(), timeout=PATIENCE_S) for _ in range(11)]
    for connection in others:
        connection.sendall(upload(40_000_000) + part)
    answers = [rest(connection) for connection in (first, *others)]
    for connection in others:
        connection.close()
    assert all(answer.startswith(b"HTTP/1.1 401 ") for answer in answers) and not spooled


def test_a_redirect_does_not_go_where_the_host_header_says(connect: Connect, closed: Closed) -> None:
    answer = rest(connect(b"GET /v1/jobs/ HTTP/1.1\r\nHost: evil.example\r\nConnection: close\r\n\r\n", app=closed[0]))
    assert b"evil.example" not in answer and answer.split()[1] == b"404"


async def refuses(scope: Any, receive: Any, send: Any) -> None:
    if scope["type"] == "http":
        await send({"type": "http.response.start", "status": 403, "headers": [(b"content-length", b"0")]})
        await send({"type": "http.response.body", "body": b""})


def test_a_body_that_trickles_after_its_answer_is_cut_off(connect: Connect) -> None:
    connection = connect(_POST % 1_000_000, app=refuses)
    assert b" 403 " in connection.recv(65536)
    connection.settimeout(0.02)

    def trickle() -> bool:
        try:
            connection.sendall(b"x")
            return connection.recv(1) == b""
        except TimeoutError:
            return False
        except OSError:
            return True

    until(trickle, "the server ends the connection")


def test_a_body_that_comes_whole_after_its_answer_is_read(connect: Connect) -> None:
    connection = connect(_POST % 4, app=refuses)
    assert b" 403 " in connection.recv(65536)
    connection.sendall(b"body")
    for _ in range(2):
        connection.sendall(_POST % 0)
        assert b" 403 " in connection.recv(65536)
