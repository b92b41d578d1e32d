"""The object store: one contract on every adapter, and what only the local one must do."""

from __future__ import annotations

import errno
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from graspd.service.model.errors import InputError, NotFoundError, StoreUnavailable
from graspd.service.store.store import Entry, Store, check_key, open_store


@pytest.fixture(params=["memory", "file", pytest.param("s3", marks=pytest.mark.s3)])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> Store:
    """Each adapter in turn."""
    if request.param == "s3":
        return open_store(request.getfixturevalue("s3_url"))
    return open_store("memory://" if request.param == "memory" else (tmp_path / "store").as_uri())


def test_an_object_is_read_back_whole_and_in_part(store: Store) -> None:
    store.put("shards/base/a.h5", bytes(range(100)))
    assert store.get("shards/base/a.h5") == bytes(range(100))
    assert store.get_range("shards/base/a.h5", 10, 5) == bytes(range(10, 15))
    assert b"".join(store.stream("shards/base/a.h5", 90)) == bytes(range(90, 100))
    assert store.size("shards/base/a.h5") == 100


def test_a_stream_comes_in_chunks_and_in_order(store: Store) -> None:
    data = bytes(i % 251 for i in range(2_500_000))
    store.put("big", data)
    chunks = list(store.stream("big"))
    assert len(chunks) > 1
    assert b"".join(chunks) == data


def test_a_second_put_is_refused_and_changes_nothing(store: Store) -> None:
    assert store.put("jobs/j/job.json", b"first") is True
    assert store.put("jobs/j/job.json", b"second") is False
    assert store.get("jobs/j/job.json") == b"first"


def test_of_many_that_put_one_name_at_once_exactly_one_wins(store: Store) -> None:
    barrier = threading.Barrier(8)
    won: list[int] = []

    def put(number: int) -> None:
        barrier.wait()
        if store.put("shards/base/x.h5", bytes([number]) * 10_000):
            won.append(number)

    threads = [threading.Thread(target=put, args=(n,)) for n in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(won) == 1
    assert store.get("shards/base/x.h5") == bytes([won[0]]) * 10_000


def test_a_deleted_object_is_gone_and_its_name_is_free(store: Store) -> None:
    store.put("jobs/a/job.json", b"1")
    store.delete("jobs/a/job.json")
    store.delete("jobs/a/job.json")
    assert not store.exists("jobs/a/job.json")
    assert [entry.key for entry in store.list("jobs")] == []
    assert store.put("jobs/a/job.json", b"2")


def test_a_missing_object_is_named(store: Store) -> None:
    with pytest.raises(NotFoundError, match="no/such"):
        store.get("no/such")
    with pytest.raises(NotFoundError, match="no/such"):
        store.get_range("no/such", 0, 1)
    assert not store.exists("no/such")


def test_a_listing_holds_all_below_a_folder_and_nothing_else(store: Store) -> None:
    for key in ("tasks/a/attempts/1.json", "tasks/a/attempts/2.json", "tasks/ab/attempts/1.json"):
        store.put(key, b"{}")
    assert sorted(entry.key for entry in store.list("tasks/a")) == [
        "tasks/a/attempts/1.json",
        "tasks/a/attempts/2.json",
    ]
    assert list(store.list("tasks/none")) == []
    after = store.list("tasks/a", offset="tasks/a/attempts/1.json")
    assert list(after) == [Entry("tasks/a/attempts/2.json", 2)]


def test_a_probe_tells_how_long_a_write_takes(store: Store) -> None:
    assert 0 < store.probe() < 5
    assert store.probe() > 0


@pytest.mark.parametrize("key", ["", "/etc/passwd", "a/../b", "a//b", "a b", "a/.hidden", "a\0b", "ä"])
def test_a_name_that_could_leave_the_store_is_refused(store: Store, key: str) -> None:
    for call in (store.get, store.size, lambda k: store.put(k, b"")):
        with pytest.raises(InputError):
            call(key)


def test_a_key_that_is_fine_comes_back() -> None:
    assert check_key("shards/base/0a.h5") == "shards/base/0a.h5"


def test_an_unfinished_local_write_is_never_seen(tmp_path: Path) -> None:
    store = open_store(tmp_path.as_uri())
    store.put("shards/base/a.h5", b"whole")
    (tmp_path / "shards" / "base" / "b.h5#123456").write_bytes(b"torn")
    assert [entry.key for entry in store.list("shards")] == ["shards/base/a.h5"]
    assert not store.exists("shards/base/b.h5")


def test_a_local_put_leaves_no_other_file(tmp_path: Path) -> None:
    store = open_store(tmp_path.as_uri())
    store.put("a/b", b"1")
    store.put("a/b", b"2")
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["b"]


def test_a_folder_that_cannot_be_made_is_one_clear_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(StoreUnavailable, match=r"store folder .*file/store cannot be written: Not a directory$"):
        open_store((tmp_path / "file" / "store").as_uri())


def test_a_store_that_vanishes_is_unavailable(tmp_path: Path) -> None:
    store = open_store((tmp_path / "store").as_uri())
    (tmp_path / "store").rmdir()
    (tmp_path / "store").write_text("in the way")
    _is_unavailable(lambda: store.put("a", b""))
    _is_unavailable(store.probe)


def _is_unavailable(call: Callable[[], object]) -> None:
    with pytest.raises(StoreUnavailable) as found:
        call()
    assert "\n" not in str(found.value)


@pytest.mark.parametrize("url", ["ftp://x", "file://host/path", "nothing", "file:relative"])
def test_a_url_that_names_no_store_is_refused(url: str) -> None:
    with pytest.raises(InputError, match="store URL"):
        open_store(url)


def test_no_address_is_signed_that_clients_could_not_reach(store: Store) -> None:
    store.put("a", b"1")
    assert store.sign("a") is None


def test_a_full_disk_is_one_clear_line_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    store = open_store(tmp_path.as_uri())
    with monkeypatch.context() as patch:
        patch.setattr("graspd.service.store.store.os.fsync", full)
        with pytest.raises(StoreUnavailable, match=r"No space left on device$"):
            store.put("shards/base/a.h5", b"data")
    assert list((tmp_path / "shards" / "base").iterdir()) == []
    assert store.put("shards/base/a.h5", b"data"), "there is room again"
