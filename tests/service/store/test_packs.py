"""Several shards in one object: what is read is what was put, from files and from S3, and what is harmed is named."""

from __future__ import annotations

import hashlib
import json
import struct
from pathlib import Path

import pytest

from service.model import names
from service.model.errors import DamagedError, DamagedShard, InputError
from service.model.states import Stage
from service.store import packs
from service.store.integrity import Checked, read_checked
from service.store.manifests import publish_shard
from service.store.packs import (
    DeadShards,
    Finder,
    find_manifest,
    find_shard,
    manifest_at,
    pack_at,
    packs_below,
    put_pack,
    read_manifests,
)  # fmt: skip
from service.store.parts import Part, part_of, preference
from service.store.records import put_record
from service.store.store import Store, open_store
from tests.damage import flipped, overwrite
from tests.packing import batches, made_of, pack

PAIR = ("a" * 32, "b" * 32)


@pytest.fixture(params=["files", pytest.param("s3", marks=pytest.mark.s3)])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> Store:
    url = request.getfixturevalue("s3_url") if request.param == "s3" else (tmp_path / "store").as_uri()
    return open_store(url)


def test_what_is_packed_is_one_object_and_reads_as_it_was(store: Store) -> None:
    made = [made_of(message) for message in batches(3)]
    key = put_pack(store, made)
    assert [entry.key for entry in store.list(names.PACKS)] == [key]
    found = read_manifests(store, pack_at(store, key))
    for (manifest, data), read in zip(made, found, strict=True):
        assert not isinstance(read, DamagedError)
        assert read == manifest.model_copy(update={"key": read.key})
        assert (store.get(read.key), store.size(read.key)) == (data, len(data))
        assert b"".join(store.stream(read.key, 5, 100)) == data[5:105]
        assert store.exists(read.key)
        assert store.sign(read.key) is None, "an address without a range would give all of the pack"
        Checked(store).check(read.key, read.sha256)
        assert find_shard(store, Stage.SYNTHESIZE, manifest.shard_id, PAIR).arrays.keys()
        assert manifest_at(store, read.key, Stage.SYNTHESIZE, manifest.shard_id) == read
    assert put_pack(store, made) == key, "the same shards are the same object"
    assert find_manifest(store, Stage.SYNTHESIZE, "f" * 32, PAIR) is None


def test_the_bytes_lie_as_the_docs_say(store: Store) -> None:
    made = [made_of(message) for message in batches(2)]
    data = store.get(put_pack(store, made))
    magic, length = struct.unpack_from("<8sQ", data)
    directory = json.loads(data[16 : 16 + length])
    body = data[16 + length :]
    assert (magic, directory["version"]) == (b"graspd\x00\x01", 1)
    for (manifest, file), row in zip(made, directory["shards"], strict=True):
        assert (row["id"], row["stage"], row["sha256"]) == (manifest.shard_id, "synthesize", manifest.sha256)
        assert body[row["start"] :][: row["length"]] == file
        said = body[row["manifest_start"] :][: row["manifest_length"]]
        assert hashlib.sha256(said).hexdigest() == row["manifest_sha256"]
        assert json.loads(said)["shard_id"] == manifest.shard_id
    assert len(body) == row["start"] + row["length"]
    name = hashlib.sha256(data[16 : 16 + length]).hexdigest()[:32]
    (key,) = [entry.key for entry in store.list(names.PACKS)]
    assert key.endswith(f"/{name}.pack")


@pytest.mark.parametrize("place", ["directory", "manifest", "file", "end"])
def test_harm_is_noticed_wherever_it_is(store: Store, place: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(packs, "_known", {})
    key = pack(store, batches(2))
    whole, data = pack_at(store, key), store.get(key)
    first, second = (made for made in read_manifests(store, whole) if not isinstance(made, DamagedError))
    part = part_of(second.key)
    assert part is not None
    at = {"directory": 40, "manifest": whole.body + 10, "file": part.start + 50}
    overwrite(store, key, data[: part.start - 1] if place == "end" else flipped(data, at[place]))
    if place == "directory":
        with pytest.raises(DamagedError, match=key):
            pack_at(store, key, anew=True)
        assert [isinstance(found, DamagedError) for _, found in packs_below(store)] == [False], "it was read before"
        monkeypatch.setattr(packs, "_known", {})
        assert [isinstance(found, DamagedError) for _, found in packs_below(store)] == [True]
        assert find_manifest(store, Stage.SYNTHESIZE, first.shard_id, PAIR) is None
    elif place == "manifest":
        assert [isinstance(made, DamagedError) for made in read_manifests(store, whole)] == [True, False]
        with pytest.raises(DamagedError, match=first.shard_id):
            Finder(store).manifest(Stage.SYNTHESIZE, first.shard_id, PAIR)
    else:
        with pytest.raises(DamagedShard, match=key):
            read_checked(store, second.key, second.sha256)
        with pytest.raises(DamagedShard):
            Checked(store).check(second.key, second.sha256)


def test_a_file_of_its_own_counts_before_a_pack_and_the_first_pack_by_name_before_the_others(store: Store) -> None:
    (message,) = batches(1)
    both = sorted(pack(store, [message], worker=worker) for worker in ("v", "w"))
    found = find_manifest(store, Stage.SYNTHESIZE, message.output, PAIR)
    assert found is not None and found.key.startswith(both[0])
    manifest, data = made_of(message, worker="third")
    publish_shard(store, manifest, data)
    assert find_manifest(store, Stage.SYNTHESIZE, message.output, PAIR) == manifest
    assert sorted([f"{both[1]}@1+2", manifest.key, found.key], key=preference)[:2] == [manifest.key, found.key]


def test_what_a_record_says_is_gone_is_not_there(store: Store) -> None:
    tasks = batches(3)
    key = pack(store, tasks)
    gone = DeadShards(shards=(tasks[1].output,))
    put_record(store, f"{names.pack_dead(key)}/{'0' * 32}.json", gone)
    there = [find_manifest(store, Stage.SYNTHESIZE, task.output, PAIR) is not None for task in tasks]
    assert there == [True, False, True]
    assert len(read_manifests(store, pack_at(store, key))) == 2


@pytest.mark.parametrize("place", ["a@1", "a@1+0", "a@-1+2", "a@01+2", "a@1+2@3+4", "../a@1+2", "a@1+2/b"])
def test_what_is_no_place_is_refused(tmp_path: Path, place: str) -> None:
    store = open_store(tmp_path.as_uri())
    store.put("a", b"0123456789")
    with pytest.raises(InputError):
        store.get(place)
    with pytest.raises(InputError):
        store.put("a@1+2", b"x")
    with pytest.raises(InputError):
        store.delete("a@1+2")
    assert store.get(str(Part("a", 1, 2))) == b"12"


def test_a_directory_of_any_length_is_read(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    key = pack(store, batches(2))
    whole = pack_at(store, key, anew=True)
    monkeypatch.setattr(packs, "_FIRST_READ", 100)
    assert pack_at(store, key, anew=True) == whole
