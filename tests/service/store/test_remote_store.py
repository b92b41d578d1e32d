"""What only a store behind a network must do, held against a real S3 server."""

from __future__ import annotations

import hashlib
import os
from urllib.parse import urlsplit

import httpx
import pytest

from graspd.service.model.errors import NotFoundError, StoreUnavailable
from graspd.service.store.store import Store, open_store
from tests.servers import MissingServer, S3Server, free_ports

pytestmark = pytest.mark.s3


@pytest.fixture
def store(s3_url: str) -> Store:
    return open_store(s3_url)


@pytest.fixture
def signing(s3_url: str, s3_server: S3Server) -> Store:
    """A store whose clients reach the server where the service does."""
    return open_store(s3_url, public_endpoint=s3_server.environment["AWS_ENDPOINT_URL"])


def test_a_large_object_comes_back_chunk_by_chunk_and_is_written_once(store: Store) -> None:
    # Larger than what the client sends in one part: parts must not slip past the refusal of a second put.
    data = os.urandom(24 * 2**20)
    assert store.put("shards/views/large.h5", data) is True
    assert store.put("shards/views/large.h5", data[::-1]) is False
    digest = hashlib.sha256()
    largest = 0
    for chunk in store.stream("shards/views/large.h5"):
        digest.update(chunk)
        largest = max(largest, len(chunk))
    assert digest.digest() == hashlib.sha256(data).digest()
    assert largest <= 2**20
    assert store.get_range("shards/views/large.h5", 2**24 - 3, 7) == data[2**24 - 3 : 2**24 + 4]


def test_a_listing_goes_on_behind_a_thousand_objects(store: Store) -> None:
    keys = [f"tasks/t/attempts/{number:04}.json" for number in range(1005)]
    for key in keys:
        store.put(key, b"{}")
    assert sorted(entry.key for entry in store.list("tasks")) == keys
    assert sorted(entry.key for entry in store.list("tasks", offset=keys[1001])) == keys[1002:]


def test_anybody_with_the_signed_address_may_read_that_object_and_no_other(signing: Store) -> None:
    signing.put("shards/base/a.h5", bytes(range(100)))
    signing.put("shards/base/b.h5", b"secret")
    address = signing.sign("shards/base/a.h5", seconds=60)
    assert address is not None
    with httpx.Client(trust_env=False, timeout=60) as client:
        assert client.get(address).content == bytes(range(100))
        part = client.get(address, headers={"Range": "bytes=10-14"})
        assert (part.status_code, part.content) == (206, bytes(range(10, 15)))
        assert client.get(address.replace("a.h5", "b.h5")).status_code == 403
        assert client.put(address, content=b"x").status_code == 403


def test_an_endpoint_of_the_service_alone_is_not_handed_out(store: Store) -> None:
    store.put("a", b"1")
    assert store.sign("a") is None


def test_an_address_is_signed_for_where_clients_reach_the_store(s3_url: str) -> None:
    store = open_store(s3_url, public_endpoint="https://files.example.org")
    assert urlsplit(store.sign("a") or "").netloc == "files.example.org"


def test_wrong_credentials_are_one_clear_line_without_the_secret(s3_url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "wrong-secret")
    with pytest.raises(StoreUnavailable) as found:
        open_store(s3_url).put("a", b"1")
    assert "\n" not in str(found.value)
    assert "wrong-secret" not in str(found.value)


def test_a_server_that_is_away_is_unavailable_for_every_call(s3_url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{free_ports(1)[0]}")
    store = open_store(s3_url)
    for call in (
        lambda: store.put("a", b"1"),
        lambda: store.get("a"),
        lambda: store.exists("a"),
        lambda: list(store.list("jobs")),
        store.probe,
    ):
        with pytest.raises(StoreUnavailable) as found:
            call()
        assert not isinstance(found.value, NotFoundError)
        assert "\n" not in str(found.value)


def test_what_was_written_is_there_after_the_server_was_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    try:
        own = S3Server()
    except MissingServer as missing:
        pytest.skip(str(missing))
    with own as server:
        for name, value in server.environment.items():
            monkeypatch.setenv(name, value)
        store = open_store(server.url)
        store.put("jobs/j/job.json", b"first")
        server.kill()
        server.start()
        assert store.put("jobs/j/job.json", b"second") is False
        assert store.get("jobs/j/job.json") == b"first"
