"""The object store: one contract on every adapter, and what only a local one or one behind a network must do."""

import errno
import os
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from unittest.mock import Mock
from urllib.parse import urlsplit

import httpx
import pytest

from graspd.service.model.errors import InputError, NotFoundError, StoreUnavailable
from graspd.service.store.store import Entry, Store, open_store
from tests.servers import S3Server, free_ports


@pytest.fixture(params=["memory", "file", pytest.param("s3", marks=pytest.mark.s3)])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> Store:
    if request.param == "s3":
        return open_store(request.getfixturevalue("s3_url"))
    return open_store("memory://" if request.param == "memory" else (tmp_path / "store").as_uri())


def test_an_object_is_read_back_whole_and_in_part(store: Store) -> None:
    data = bytes(i % 251 for i in range(2_500_000))
    assert store.put("shards/base/a.h5", data) is True
    assert store.put("shards/base/a.h5", b"second") is False
    assert store.get("shards/base/a.h5") == data
    assert store.get_range("shards/base/a.h5", 10, 5) == data[10:15]
    chunks = list(store.stream("shards/base/a.h5", 90))
    assert len(chunks) > 1 and b"".join(chunks) == data[90:]
    assert store.size("shards/base/a.h5") == len(data)
    assert store.sign("shards/base/a.h5") is None, "clients could not reach it"
    assert 0 < store.probe() < 5


def test_of_many_that_put_one_name_at_once_exactly_one_wins(store: Store) -> None:
    barrier = threading.Barrier(8)

    def put(number: int) -> bool:
        barrier.wait()
        return store.put("shards/base/x.h5", bytes([number]) * 10_000)

    with ThreadPoolExecutor(8) as pool:
        (won,) = [number for number, is_first in enumerate(pool.map(put, range(8))) if is_first]
    assert store.get("shards/base/x.h5") == bytes([won]) * 10_000


def test_a_deleted_object_is_gone_and_its_name_is_free(store: Store) -> None:
    store.put("jobs/a/job.json", b"1")
    store.delete("jobs/a/job.json")
    store.delete("jobs/a/job.json")
    assert not store.exists("jobs/a/job.json") and not list(store.list("jobs"))
    for read in (store.get, lambda key: store.get_range(key, 0, 1)):
        with pytest.raises(NotFoundError, match="jobs/a"):
            read("jobs/a/job.json")
    assert store.put("jobs/a/job.json", b"2")


def test_a_listing_holds_all_below_a_folder_and_nothing_else(store: Store) -> None:
    keys = [f"tasks/{name}.json" for name in ("a/attempts/1", "a/attempts/2", "ab/attempts/1")]
    for key in keys:
        store.put(key, b"{}")
    assert sorted(entry.key for entry in store.list("tasks/a")) == keys[:2]
    assert list(store.list("tasks/none")) == []
    assert list(store.list("tasks/a", offset=keys[0])) == [Entry(keys[1], 2)]


@pytest.mark.parametrize("key", ["", "/etc/passwd", "a/../b", "a//b", "a b", "a/.hidden", "a\0b", "ä"])
def test_a_name_that_could_leave_the_store_is_refused(store: Store, key: str) -> None:
    for call in (store.get, store.size, lambda k: store.put(k, b"")):
        with pytest.raises(InputError):
            call(key)


def test_an_unfinished_write_is_never_seen(tmp_path: Path) -> None:
    store = open_store(tmp_path.as_uri())
    for data in (b"whole", b"again"):
        store.put("shards/base/a.h5", data)
    assert [path.name for path in (tmp_path / "shards" / "base").iterdir()] == ["a.h5"]
    (tmp_path / "shards" / "base" / "b.h5#123456").write_bytes(b"torn")
    assert [entry.key for entry in store.list("shards")] == ["shards/base/a.h5"]
    assert not store.exists("shards/base/b.h5")


def test_a_folder_that_cannot_be_used_is_one_clear_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = open_store((tmp_path / "store").as_uri())
    (tmp_path / "store").rmdir()
    (tmp_path / "store").write_text("in the way")
    for call in (lambda: store.put("a", b""), store.probe):
        with pytest.raises(StoreUnavailable) as found:
            call()
        assert "\n" not in str(found.value)
    with pytest.raises(StoreUnavailable, match=r"store folder .*store/inner cannot be written: Not a directory$"):
        open_store((tmp_path / "store" / "inner").as_uri())
    monkeypatch.setattr(os, "access", lambda *_: False)  # root may write everywhere
    with pytest.raises(StoreUnavailable, match=r"cannot be written: Permission denied$"):
        open_store(tmp_path.as_uri())


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("ftp://x", "store URL"),
        ("nothing", "store URL"),
        ("file://host/path", "absolute"),
        ("file:relative", "absolute"),
    ],
)
def test_a_url_that_names_no_store_is_refused(url: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        open_store(url)


def test_a_full_disk_is_one_clear_line_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = open_store(tmp_path.as_uri())
    full = Mock(side_effect=OSError(errno.ENOSPC, "No space left on device"))
    with monkeypatch.context() as patch:
        patch.setattr("graspd.service.store.store.os.fsync", full)
        with pytest.raises(StoreUnavailable, match=r"No space left on device$"):
            store.put("shards/base/a.h5", b"data")
    assert list((tmp_path / "shards" / "base").iterdir()) == []
    assert store.put("shards/base/a.h5", b"data"), "there is room again"


@pytest.mark.s3
def test_a_large_object_comes_in_chunks_and_is_written_once(s3_url: str) -> None:
    store = open_store(s3_url)
    # Larger than what the client sends in one part: parts must not slip past the refusal of a second put.
    data = os.urandom(24 * 2**20)
    assert store.put("shards/views/large.h5", data) is True
    assert store.put("shards/views/large.h5", data[::-1]) is False
    chunks = list(store.stream("shards/views/large.h5"))
    assert b"".join(chunks) == data and max(map(len, chunks)) <= 2**20
    assert store.get_range("shards/views/large.h5", 2**24 - 3, 7) == data[2**24 - 3 : 2**24 + 4]


@pytest.mark.s3
def test_a_signed_address_opens_that_object_and_no_other(s3_url: str, s3_server: S3Server) -> None:
    store = open_store(s3_url, public_endpoint=s3_server.environment["AWS_ENDPOINT_URL"])
    store.put("shards/base/a.h5", bytes(range(100)))
    store.put("shards/base/b.h5", b"secret")
    address = store.sign("shards/base/a.h5", seconds=60)
    assert address is not None
    with httpx.Client(trust_env=False, timeout=60) as client:
        assert client.get(address).content == bytes(range(100))
        part = client.get(address, headers={"Range": "bytes=10-14"})
        assert (part.status_code, part.content) == (206, bytes(range(10, 15)))
        assert client.get(address.replace("a.h5", "b.h5")).status_code == 403
        assert client.put(address, content=b"x").status_code == 403
    elsewhere = open_store(s3_url, public_endpoint="https://files.example.org")
    assert urlsplit(elsewhere.sign("a") or "").netloc == "files.example.org"


@pytest.mark.s3
def test_wrong_credentials_are_one_clear_line_without_the_secret(s3_url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "wrong-secret")
    with pytest.raises(StoreUnavailable) as found:
        open_store(s3_url).put("a", b"1")
    assert "\n" not in str(found.value) and "wrong-secret" not in str(found.value)


@pytest.mark.s3
def test_a_server_that_is_away_is_unavailable_for_every_call(s3_url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{free_ports(1)[0]}")
    store = open_store(s3_url)
    reads = (lambda: store.get("a"), lambda: store.exists("a"), lambda: list(store.list("jobs")))
    for call in (lambda: store.put("a", b"1"), store.probe, *reads):
        with pytest.raises(StoreUnavailable) as found:
            call()
        assert not isinstance(found.value, NotFoundError)
        assert "\n" not in str(found.value)
