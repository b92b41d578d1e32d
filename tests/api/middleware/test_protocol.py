"""Bodies that go on after their answer, on a real server."""

from __future__ import annotations

from typing import Any

import pytest

from tests.api.test_connections import Connect, _Quick, connect
from tests.waiting import until

__all__ = ["connect"]
_HEAD = b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: %d\r\n\r\n"


async def refuses(scope: Any, receive: Any, send: Any) -> None:
    """Answers without a look at the body."""
    if scope["type"] == "http":
        await send({"type": "http.response.start", "status": 403, "headers": [(b"content-length", b"0")]})
        await send({"type": "http.response.body", "body": b""})


def test_a_body_that_trickles_after_its_answer_is_cut_off(connect: Connect, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_Quick, "rest_s", 0.2)
    connection = connect(_HEAD % 1_000_000, app=refuses)
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


def test_a_body_that_comes_whole_after_its_answer_is_read(connect: Connect, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_Quick, "rest_s", 0.2)
    connection = connect(_HEAD % 4, app=refuses)
    assert b" 403 " in connection.recv(65536)
    connection.sendall(b"body")
    for _ in range(2):
        connection.sendall(_HEAD % 0)
        assert b" 403 " in connection.recv(65536)
