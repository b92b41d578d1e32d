"""Shards that are not what they were: refused by name, wherever they are read."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import Any

import pytest

from service.model.errors import DamagedShard
from service.model.states import Stage
from service.store.integrity import Checked, read_checked
from service.store.manifests import ShardManifest, load_shard
from service.store.shards import read_shard
from service.store.store import Store, open_store
from tests.damage import cut, flip, flipped, flipped_values, overwrite, remove
from tests.fakes import make_shard, message_for

HARMS = (flip, cut, remove)


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return open_store((tmp_path / "store").as_uri())


@pytest.fixture
def shard(store: Store) -> ShardManifest:
    return make_shard(store, message_for())


@pytest.mark.parametrize("harm", HARMS)
def test_a_harmed_shard_is_refused_with_its_name(store: Store, shard: ShardManifest, harm: Any) -> None:
    """Also where it was good when it was checked before."""
    checked = Checked(store)
    checked.check(shard.key, shard.sha256)
    harm(store, shard.key)
    for read in (
        lambda: load_shard(store, Stage.SYNTHESIZE, shard.shard_id),
        lambda: read_checked(store, shard.key, shard.sha256),
        lambda: Checked(store).check(shard.key, shard.sha256),
        lambda: checked.check(shard.key, shard.sha256),
    ):
        with pytest.raises(DamagedShard, match=shard.shard_id):
            read()


def test_an_intact_shard_is_read_through_once(
    store: Store, shard: ShardManifest, monkeypatch: pytest.MonkeyPatch
) -> None:
    checked, reads = Checked(store), []
    stream = Store.stream
    monkeypatch.setattr(Store, "stream", lambda *args: reads.append(args) or stream(*args))
    for _ in range(3):
        checked.check(shard.key, shard.sha256)
    assert len(reads) == 1


def test_a_file_beside_its_manifest_is_checked_against_it(tmp_path: Path, store: Store, shard: ShardManifest) -> None:
    path = tmp_path / "store" / shard.key
    assert read_shard(path)["grasp/hand_pose"].shape == (32, 7)
    # Of the attributes only the manifest knows what they were.
    overwrite(store, shard.key, store.get(shard.key).replace(b"gripper", b"grapper"))
    with pytest.raises(DamagedShard, match=shard.shard_id):
        read_shard(path)


@pytest.mark.parametrize("name", ["SHA256SUMS", "checksums.sha256"])
def test_a_file_of_an_export_is_checked_against_its_list(
    tmp_path: Path, store: Store, shard: ShardManifest, name: str
) -> None:
    data = store.get(shard.key)
    path = tmp_path / "out" / "hand" / "object" / "base-00000.h5"
    path.parent.mkdir(parents=True)
    (tmp_path / "out" / name).write_text(f"{hashlib.sha256(data).hexdigest()}  hand/object/base-00000.h5\n")
    path.write_bytes(data.replace(b"gripper", b"grapper"))
    with pytest.raises(DamagedShard, match="base-00000"):
        read_shard(path)


def test_a_file_that_stands_alone_knows_its_own_values(tmp_path: Path, store: Store, shard: ShardManifest) -> None:
    data = store.get(shard.key)
    path = tmp_path / "grasps.h5"
    path.write_bytes(flipped_values(data, read_shard(data)["grasp/joint_positions"]))
    with pytest.raises(DamagedShard, match=r"grasps\.h5.*grasp/joint_positions"):
        read_shard(path)


def test_a_file_that_cannot_be_read_is_refused_in_one_line(tmp_path: Path, store: Store, shard: ShardManifest) -> None:
    data = store.get(shard.key)
    path = tmp_path / "grasps.h5"
    for at in range(64, len(data), max(1, len(data) // 200)):
        path.write_bytes(flipped(data, at))
        try:
            read_shard(path)
        except Exception as error:
            assert type(error).__module__ == "service.model.errors", (at, error)
            assert "\n" not in str(error), at


def turn_in_secret(tmp_path: Path, key: str, at: int) -> None:
    """Another byte, and the time of change kept."""
    path = tmp_path / "store" / key
    facts = path.stat()
    path.write_bytes(flipped(path.read_bytes(), at))
    os.utime(path, ns=(facts.st_atime_ns, facts.st_mtime_ns))


def test_bytes_that_turned_in_secret_are_not_given(tmp_path: Path, store: Store, shard: ShardManifest) -> None:
    checked = Checked(store)
    checked.check(shard.key, shard.sha256)
    turn_in_secret(tmp_path, shard.key, 100)
    with pytest.raises(DamagedShard, match=shard.shard_id):
        checked.stream(shard.key, shard.sha256, 50, 10)
    with pytest.raises(DamagedShard):
        checked.check(shard.key, shard.sha256)


def test_a_large_file_is_cut_off_before_what_turned(tmp_path: Path, store: Store) -> None:
    data = bytes(range(256)) * 10_000
    store.put("large.bin", data)
    digest, checked = hashlib.sha256(data).hexdigest(), Checked(store)
    assert b"".join(checked.stream("large.bin", digest, 0, len(data))) == data
    assert b"".join(checked.stream("large.bin", digest, 1_000_000, 100_000)) == data[1_000_000:1_100_000]
    turn_in_secret(tmp_path, "large.bin", 2_200_000)
    got = list[bytes]()
    with pytest.raises(DamagedShard):
        got.extend(checked.stream("large.bin", digest, 0, len(data)))
    assert b"".join(got) == data[: 2 << 20]
