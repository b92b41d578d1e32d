"""POST to addresses of strangers: which machines it reaches, and what an answer may do."""

import http.server
import ipaddress
import socket
import threading
from collections.abc import Iterator
from typing import Any
from unittest.mock import Mock

import pytest

from graspd.service.model.errors import InputError
from graspd.service.model.webhooks import check_url
from graspd.service.pipeline import webhook_dispatcher
from graspd.service.pipeline.webhook_dispatcher import is_public, parse_networks, post

LOOPBACK = parse_networks("127.0.0.0/8")


class Ear(http.server.BaseHTTPRequestHandler):
    """Notes what it is sent; answers as the path says."""

    heard: list[tuple[str, bytes, dict[str, str]]]

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        self.heard.append((self.path, body, dict(self.headers)))
        status = int(self.path.rpartition("/")[2])
        self.send_response(status)
        if 300 <= status < 400:
            self.send_header("Location", f"http://127.0.0.1:{self.server.server_address[1]}/stolen/200")
        self.send_header("Content-Length", "2000000000")
        self.end_headers()
        self.wfile.write(b"x" * 5000)

    def log_message(self, format: str, *args: Any) -> None:
        pass


@pytest.fixture
def ear() -> Iterator[tuple[str, list[Any]]]:
    Ear.heard = []
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Ear) as server:
        server.daemon_threads = True
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{server.server_address[1]}", Ear.heard
        server.shutdown()
        thread.join()


#: Addresses of this machine, of private and special networks, of metadata services, and IPv6 that means one of them.
PRIVATE = """
    127.0.0.1 127.9.9.9 0.0.0.0 10.0.0.1 172.16.3.4 192.168.1.1 169.254.169.254 100.64.0.1 224.0.0.1 255.255.255.255
    192.0.2.1 240.0.0.1 192.0.0.10 192.88.99.1 161.26.0.10 166.9.0.1 168.63.129.16 100.100.100.200 192.0.0.192
    64:ff9b::a83f:8110 2002:a83f:8110:: 3fff::1 ::1 :: fe80::1 fd00::1 fec0::1 ff02::1 ::ffff:127.0.0.1
    ::ffff:169.254.169.254 2002:7f00:1:: 64:ff9b::a9fe:a9fe 64:ff9b:1::808:808 ::ffff:168.63.129.16 fd00:ec2::254
    2001:0:1::1
"""


@pytest.mark.parametrize("address", ["8.8.8.8", "2606:4700::1111", *PRIVATE.split()])
def test_only_machines_of_the_internet_are_public(address: str) -> None:
    assert is_public(ipaddress.ip_address(address)) is (address not in PRIVATE.split())


@pytest.mark.parametrize("host", ["127.0.0.1", "[::1]", "[::ffff:127.0.0.1]", "localhost", "2130706433", "0x7f.1"])
def test_no_way_of_writing_this_machine_reaches_it(ear: tuple[str, list[Any]], host: str) -> None:
    port = ear[0].rpartition(":")[2]
    assert post(f"http://{host}:{port}/in/200", b"{}", {}, patience_s=5).status is None and not ear[1]


def test_a_name_is_looked_up_once(ear: tuple[str, list[Any]], monkeypatch: pytest.MonkeyPatch) -> None:
    port = int(ear[0].rpartition(":")[2])
    answers = iter(["93.184.216.34", "127.0.0.1"])
    dialled: list[Any] = []

    def resolve(host: str, *_: Any, **__: Any) -> Any:
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, "", (next(answers), port))]

    def dial(address: Any, **_: Any) -> Any:
        dialled.append(address)
        raise OSError("no way there in a test")

    monkeypatch.setattr(webhook_dispatcher.socket, "getaddrinfo", resolve)
    monkeypatch.setattr(webhook_dispatcher.socket, "create_connection", dial)
    assert post(f"http://rebound.example:{port}/in/200", b"{}", {}).status is None
    assert dialled == [("93.184.216.34", port)] and not ear[1]


def test_where_the_operator_allows_it_the_body_arrives(ear: tuple[str, list[Any]]) -> None:
    assert post(f"{ear[0]}/in/200", b"body", {"X-Mine": "yes"}, allowed=LOOPBACK).is_accepted
    path, body, headers = ear[1][0]
    assert (path, body, headers["X-Mine"]) == ("/in/200", b"body", "yes")


@pytest.mark.parametrize("status", [301, 302, 307, 308])
def test_redirects_are_not_followed(ear: tuple[str, list[Any]], status: int) -> None:
    answer = post(f"{ear[0]}/in/{status}", b"body", {}, allowed=LOOPBACK)
    assert not answer.is_accepted and "not followed" in answer.detail
    assert [path for path, _, _ in ear[1]] == [f"/in/{status}"]


def test_an_address_without_answer_or_host_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        answer = post(f"http://127.0.0.1:{silent.getsockname()[1]}/", b"{}", {}, allowed=LOOPBACK, patience_s=0.2)
    assert answer.status is None and not answer.is_accepted
    lost = Mock(side_effect=OSError("resolver 10.0.0.2: NXDOMAIN"))
    monkeypatch.setattr(webhook_dispatcher.socket, "getaddrinfo", lost)
    answer = post("http://nothing.internal/", b"{}", {})
    assert not answer.is_final and answer.detail == "the host of the address cannot be looked up"


@pytest.mark.parametrize(
    "url",
    "ftp://a.example/|file:///etc/passwd|https://|https://me:pw@a.example/|https://a.example/\r\nX: y|https://[::1|"
    f"https://a.example:99999/|https://ä.example/|https://{'a' * 600}".split("|"),
)
def test_what_is_no_address_is_refused_when_it_is_made(url: str) -> None:
    with pytest.raises(InputError):
        check_url(url)


@pytest.mark.parametrize("addresses", [["10.20.30.40"], ["93.184.216.34", "10.20.30.40"]])
def test_a_name_with_a_private_address_is_refused_untold(monkeypatch: pytest.MonkeyPatch, addresses: list[str]) -> None:
    found = [(socket.AF_INET, 1, 6, "", (one, 80)) for one in addresses]
    monkeypatch.setattr(webhook_dispatcher.socket, "getaddrinfo", lambda *_, **__: found)
    answer = post("http://db.internal/", b"{}", {})
    assert answer.status is None and answer.is_final
    assert "GRASPD_WEBHOOK_NETWORKS" in answer.detail and "10.20" not in answer.detail


def test_a_look_up_that_does_not_end_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    let_go = threading.Event()
    monkeypatch.setattr(webhook_dispatcher, "LOOK_UP_S", 0.05)
    monkeypatch.setattr(webhook_dispatcher.socket, "getaddrinfo", lambda *_, **__: let_go.wait(60) and [])
    try:
        assert post("http://slow.example/", b"{}", {}).status is None
    finally:
        let_go.set()


def test_all_addresses_of_a_name_together_get_the_time_of_one(monkeypatch: pytest.MonkeyPatch) -> None:
    found = [(socket.AF_INET, 1, 6, "", (f"93.184.216.{number}", 80)) for number in range(50)]
    clock = [100.0]

    def silent(_: Any, timeout: float) -> Any:
        clock[0] += min(timeout, 4.0)
        raise TimeoutError

    monkeypatch.setattr(webhook_dispatcher.socket, "getaddrinfo", lambda *_, **__: found)
    monkeypatch.setattr(webhook_dispatcher.socket, "create_connection", silent)
    monkeypatch.setattr(webhook_dispatcher.time, "monotonic", lambda: clock[0])
    assert post("http://many.example/", b"{}", {}, patience_s=10).status is None
    assert clock[0] == 110.0
