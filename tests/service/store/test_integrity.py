"""Shards that are not what they were, or hold what is not theirs: refused by name, wherever they are read."""

import hashlib
import os
import resource
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from pydantic import ValidationError

from graspd.service.model.errors import DamagedShard, InputError
from graspd.service.model.states import Stage
from graspd.service.store import validity
from graspd.service.store.integrity import CheckedObjects, read_checked
from graspd.service.store.manifests import ShardManifest, load_shard
from graspd.service.store.shards import read_shard, write_shard
from graspd.service.store.store import Store, open_store
from tests.damage import cut, flip, flipped, flipped_values, overwrite, remove
from tests.fakes import make_shard, message_for
from tests.worker.files.test_curation import shard as base_shard

HARMS = (flip, cut, remove)


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return open_store((tmp_path / "store").as_uri())


@pytest.fixture
def shard(store: Store) -> ShardManifest:
    return make_shard(store, message_for())


@pytest.mark.parametrize("harm", HARMS)
def test_a_harmed_shard_is_refused_with_its_name(
    store: Store, shard: ShardManifest, monkeypatch: pytest.MonkeyPatch, harm: Any
) -> None:
    """Also where it was good when it was checked before."""
    checked = CheckedObjects(store)
    checked.check(shard.key, shard.sha256)
    with monkeypatch.context() as patch:
        patch.delattr(Store, "stream")
        checked.check(shard.key, shard.sha256)
    harm(store, shard.key)
    for read in (
        lambda: load_shard(store, Stage.SYNTHESIZE, shard.shard_id),
        lambda: read_checked(store, shard.key, shard.sha256),
        lambda: CheckedObjects(store).check(shard.key, shard.sha256),
        lambda: checked.check(shard.key, shard.sha256),
    ):
        with pytest.raises(DamagedShard, match=shard.shard_id):
            read()


def test_a_file_is_checked_against_its_manifest_or_list(tmp_path: Path, store: Store, shard: ShardManifest) -> None:
    stored, exported = tmp_path / "store" / shard.key, tmp_path / "out" / "hand" / "object" / "base-00000.h5"
    data = store.get(shard.key)
    assert read_shard(stored)["grasp/hand_pose"].shape == (32, 7)
    # Of the attributes only the manifest or a list knows what they were.
    harmed = data.replace(b"gripper", b"grapper")
    overwrite(store, shard.key, harmed)
    with pytest.raises(DamagedShard, match=shard.shard_id):
        read_shard(stored)
    exported.parent.mkdir(parents=True)
    for name in ("SHA256SUMS", "checksums.sha256"):
        listed = tmp_path / "out" / name
        listed.write_text(f"{hashlib.sha256(data).hexdigest()}  hand/object/base-00000.h5\n")
        exported.write_bytes(harmed)
        with pytest.raises(DamagedShard, match="base-00000"):
            read_shard(exported)
        listed.unlink()


def test_a_file_that_stands_alone_knows_its_own_values(tmp_path: Path, store: Store, shard: ShardManifest) -> None:
    data = store.get(shard.key)
    path = tmp_path / "grasps.h5"
    path.write_bytes(flipped_values(data, read_shard(data)["grasp/joint_positions"]))
    with pytest.raises(DamagedShard, match=r"grasps\.h5.*grasp/joint_positions"):
        read_shard(path)


def test_a_file_that_cannot_be_read_is_refused_in_one_line(tmp_path: Path, store: Store, shard: ShardManifest) -> None:
    data = store.get(shard.key)
    path = tmp_path / "grasps.h5"
    for at in range(64, len(data), max(1, len(data) // 50)):
        path.write_bytes(flipped(data, at))
        try:
            read_shard(path)
        except Exception as error:
            assert type(error).__module__ == "graspd.service.model.errors", (at, error)
            assert "\n" not in str(error), at


@pytest.mark.parametrize(("turned", "given"), [(100, 0), (2_200_000, 2 << 20)])
def test_bytes_that_turned_in_secret_are_not_given(tmp_path: Path, store: Store, turned: int, given: int) -> None:
    data = bytes(range(256)) * 10_000
    store.put("large.bin", data)
    digest, checked = hashlib.sha256(data).hexdigest(), CheckedObjects(store)
    assert b"".join(checked.stream("large.bin", digest, 0, len(data))) == data
    assert b"".join(checked.stream("large.bin", digest, 1_000_000, 100_000)) == data[1_000_000:1_100_000]
    path = tmp_path / "store" / "large.bin"
    facts = path.stat()
    path.write_bytes(flipped(data, turned))
    os.utime(path, ns=(facts.st_atime_ns, facts.st_mtime_ns))
    if not given:  # told before the first byte of an answer
        with pytest.raises(DamagedShard, match="some of its bytes changed"):
            checked.stream("large.bin", digest, 50, 100)
    got = list[bytes]()
    with pytest.raises(DamagedShard):
        got.extend(checked.stream("large.bin", digest, 0, len(data)))
    assert b"".join(got) == data[:given]
    with pytest.raises(DamagedShard):
        checked.check("large.bin", digest)


#: Columns valid, feasible and success of a grasp (None: absent), and whether it is valid, or feasible and unvalidated.
STATUSES = [
    ((0, 1, None), False, True),
    ((1, None, None), False, True),  # graspd 0.1, not validated: not taken for valid
    ((1, 1, 1), True, False),
    ((1, 1, -1), False, True),
    ((0, 1, 0), False, False),
    ((0, 0, -1), False, False),
]


@pytest.mark.parametrize(("said", "is_valid", "is_unvalidated"), STATUSES)
def test_a_verdict_counts_only_where_there_is_one(said: Any, is_valid: bool, is_unvalidated: bool) -> None:
    named = zip(("valid", "feasible", "success"), said, strict=True)
    columns = {f"quality/{name}": np.array([value]) for name, value in named if value is not None}
    assert validity.selection_mask(columns).tolist() == [is_valid]
    assert validity.selection_mask(columns, unvalidated=True).tolist() == [is_unvalidated]


POSES = "grasp/hand_pose"


#: Columns that the schema does not describe, or none where it needs one.
MISFITS = {
    r"grasp/hand_pose has 3 axes; the schema says \(N, 7\)": (POSES, np.zeros((1, 32, 7))),
    "axis 7 has length 6, expected 7": (POSES, np.zeros((32, 6))),
    "needs the dataset 'grasp/hand_pose'": (POSES, None),
    "no dataset 'grasp/colour'": ("grasp/colour", np.zeros(32)),
}


@pytest.mark.parametrize("words", MISFITS)
def test_what_the_schema_does_not_say_is_not_written(store: Store, shard: ShardManifest, words: str) -> None:
    found = read_shard(store.get(shard.key))
    columns: dict[str, Any] = {**found.arrays, **dict([MISFITS[words]])}
    with pytest.raises(InputError, match=words):
        write_shard("base", {name: array for name, array in columns.items() if array is not None}, found.attributes)


def test_another_file_than_was_asked_for_is_refused(tmp_path: Path, store: Store, shard: ShardManifest) -> None:
    with pytest.raises(InputError, match="a scene shard is needed"):
        read_shard(store.get(shard.key), kind="scene")
    h5py.File(tmp_path / "plain.h5", "w").close()
    with pytest.raises(InputError, match="no graspd shard"):
        read_shard(tmp_path / "plain.h5")


def test_a_manifest_without_its_grasps_is_refused(shard: ShardManifest) -> None:
    with pytest.raises(ValidationError, match="a summary of each grasp"):
        ShardManifest.model_validate(shard.model_dump() | {"grasps": ()})


def virtual(file: h5py.File, secret: Path) -> None:
    layout = h5py.VirtualLayout((4, 7), "f8")
    layout[:] = h5py.VirtualSource(str(secret), "secret", (4, 7))
    file.create_virtual_dataset(POSES, layout)


def deflated_zeros(file: h5py.File, _: Path) -> None:
    dataset = file.create_dataset(POSES, (50_000_000, 7), "f8", chunks=(1 << 20, 7), compression="gzip")
    piece = zlib.compress(bytes(dataset.chunks[0] * 7 * 8), 9)
    for start in range(0, 48 << 20, 1 << 20):
        dataset.id.write_direct_chunk((start, 0), piece)


def under_many_names(file: h5py.File, _: Path) -> None:
    file[POSES] = np.zeros((1000, 7))
    for number in range(500):
        file[f"name{number}"] = file[POSES]


#: Shards with values that are not theirs, by what is told of each.
CHANGES: dict[str, Callable[[h5py.File, Path], object]] = {
    "grasp/hand_pose is a link": lambda file, secret: file.update({POSES: h5py.ExternalLink(str(secret), "/secret")}),
    "hand_pose is a link; a shard": lambda file, _: file.update({POSES: h5py.SoftLink("/pregrasp/hand_pose")}),
    "in another file": lambda file, secret: file.create_dataset(POSES, (4, 7), "f8", external=[(secret, 0, 4 * 7 * 8)]),
    "another file; a shard holds its own": virtual,
    "cannot contain": lambda file, _: file.create_dataset(
        POSES, (50_000_000, 7), "f8", chunks=(4096, 7), fillvalue=1.0
    ),
    "too much for a shard": deflated_zeros,
    "is a link; a shard contains no links": under_many_names,
    "more than 1000 datasets": lambda file, _: [file.create_group(f"g{number}") for number in range(1200)],
}


@pytest.mark.parametrize("words", CHANGES)
@pytest.mark.parametrize("as_bytes", [False, True])
def test_foreign_values_are_refused(words: str, as_bytes: bool, tmp_path: Path) -> None:
    secret, shard = tmp_path / "secret.h5", tmp_path / "shard.h5"
    with h5py.File(secret, "w") as file:
        file["secret"] = np.full((4, 7), 42.0)
    base_shard(shard, 1)
    with h5py.File(shard, "r+") as file:
        if "1000" not in words:
            del file[POSES]
        CHANGES[words](file, secret)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError, match=words):
        read_shard(shard.read_bytes() if as_bytes else shard)
    # The file that makes values up claims 2.8 GB; KiB.
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 500 * 1024
