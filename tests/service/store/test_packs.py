"""Packs of graspd 0.2 are taken apart: every shard is there as it was, whenever it breaks off, and harm is named."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

import pytest

from graspd.service.model import names
from graspd.service.model.errors import StoreUnavailable
from graspd.service.model.messages import TaskMessage
from graspd.service.model.states import Stage
from graspd.service.store import packs
from graspd.service.store.integrity import read_checked
from graspd.service.store.manifests import load_manifest, load_shard, publish_shard, shard_exists
from graspd.service.store.packs import has_packs, take_apart
from graspd.service.store.store import Store, open_store
from tests.damage import flipped, overwrite
from tests.packs import batches, made_of, pack


@pytest.fixture(params=["files", pytest.param("s3", marks=pytest.mark.s3)])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> Store:
    url = request.getfixturevalue("s3_url") if request.param == "s3" else (tmp_path / "store").as_uri()
    return open_store(url)


def there(store: Store, messages: list[TaskMessage]) -> list[bool]:
    return [shard_exists(store, Stage.SYNTHESIZE, message.output) for message in messages]


def test_what_was_in_a_pack_has_a_file_of_its_own(store: Store) -> None:
    assert not has_packs(store)
    messages = batches(3)
    pack(store, messages)
    assert has_packs(store)
    found = list(take_apart(store))
    assert not has_packs(store)
    assert [manifest.shard_id for manifest in found] == [message.output for message in messages]
    for message, manifest in zip(messages, found, strict=True):
        wanted, data = made_of(message)
        assert store.get(names.shard_file(Stage.SYNTHESIZE, message.output))[:8] == data[:8]
        assert load_shard(store, Stage.SYNTHESIZE, message.output).attributes["batch"] == message.batch
        assert load_manifest(store, Stage.SYNTHESIZE, message.output) == manifest
        assert (manifest.key, manifest.batches) == (wanted.key, 1)
    assert list(take_apart(store)) == []


@pytest.mark.parametrize("breaks_at", range(1, 8))
def test_it_may_break_off_and_is_continued(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, breaks_at: int) -> None:
    store, messages, calls = open_store((tmp_path / "store").as_uri()), batches(3), 0
    pack(store, messages[:2], dead=messages[1:2])
    pack(store, messages[2:])

    def breaking(original: Callable[..., object]) -> Callable[..., object]:
        def call(self: Store, *args: object) -> object:
            nonlocal calls
            calls += 1
            if calls == breaks_at:
                raise StoreUnavailable("gone")
            return original(self, *args)

        return call

    with monkeypatch.context() as patch:
        for name in ("put", "delete"):
            patch.setattr(Store, name, breaking(getattr(Store, name)))
        with pytest.raises(StoreUnavailable):
            list(take_apart(store))
    list(take_apart(store))
    assert there(store, messages) == [True, False, True]
    assert not has_packs(store)
    for message in (messages[0], messages[2]):
        manifest = load_manifest(store, Stage.SYNTHESIZE, message.output)
        read_checked(store, manifest.key, manifest.sha256)


def test_a_file_of_its_own_counts_before_one_in_a_pack(store: Store) -> None:
    (message,) = batches(1)
    manifest, data = made_of(message, worker="first")
    publish_shard(store, manifest, data)
    pack(store, [message], worker="second")
    assert list(take_apart(store)) == [manifest]
    assert load_manifest(store, Stage.SYNTHESIZE, message.output).worker == "first"


@pytest.mark.parametrize("place", ["directory", "manifest", "file", "end"])
def test_harm_moves_the_pack_aside_and_costs_no_more(store: Store, place: str) -> None:
    messages = batches(2)
    key = pack(store, messages)
    data = store.get(key)
    body, rows = packs._directory(key, data)
    at = {"directory": 40, "manifest": body + rows[0].manifest_start + 10, "file": body + rows[0].start + 50}
    overwrite(store, key, data[: body + rows[1].start - 1] if place == "end" else flipped(data, at[place]))
    list(take_apart(store))
    assert store.exists(f"damaged/{key}")
    assert not has_packs(store)
    wanted = {"directory": [False, False], "manifest": [False, True], "file": [True, True], "end": [True, True]}[place]
    assert there(store, messages) == wanted
    files = [store.exists(names.shard_file(Stage.SYNTHESIZE, message.output)) for message in messages]
    intact = {"directory": [False, False], "manifest": [False, True], "file": [False, True], "end": [False, False]}
    assert files == intact[place]
    for message, is_intact in zip(messages, files, strict=True):
        if is_intact:
            manifest = load_manifest(store, Stage.SYNTHESIZE, message.output)
            assert hashlib.sha256(store.get(manifest.key)).hexdigest() == manifest.sha256
