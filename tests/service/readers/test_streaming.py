"""Pictures read from a store by ranges of bytes past the HDF5 library: the same, few requests, faults by name."""

from __future__ import annotations

import hashlib
import os
import pickle
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from obstore.store import MemoryStore

from graspd.service.model.errors import DamagedShard, InputError, StoreUnavailable
from graspd.service.readers import Pictures, ShardCache, ShardFile, Shards, open_shards, prefetched, ranges
from graspd.service.readers.ranges import RowTable, read_file
from graspd.service.store.columns import SCHEMAS
from graspd.service.store.store import Store, open_store
from tests.conftest import REPOSITORY
from tests.service.readers.box_scenes import VIEWS
from tests.shell import completed

VIEWS_KEY = f"shards/views/{'c' * 32}.h5"


@pytest.fixture
def shards(box: Path, tmp_path: Path) -> Shards:
    return streamed(box, open_store("memory://"), tmp_path / "cache")


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int, int]]:
    """Every range that a store is asked for."""
    found: list[tuple[str, int, int]] = []
    get_range = Store.get_range
    monkeypatch.setattr(Store, "get_range", lambda self, *args: found.append(args) or get_range(self, *args))
    return found


def streamed(box: Path, store: Store, cache: Path) -> Shards:
    """The shards of a folder, put into a store."""
    files = []
    for file in open_shards(box):
        assert file.path is not None
        data, key = file.path.read_bytes(), f"shards/{file.kind}/{file.id}.h5"
        store.put(key, data)
        digest = hashlib.sha256(data).hexdigest()
        files.append(ShardFile(file.id, file.kind, file.hand, file.object, file.batch, key=key, sha256=digest))
    return Shards(tuple(files), store, ShardCache(cache), stream=True)


def same(first: Any, second: Any) -> None:
    assert len(first) == len(second)
    for one, other in zip(first, second, strict=True):
        assert one.keys() == other.keys()
        for name, value in one.items():
            np.testing.assert_array_equal(value, other[name])


@pytest.mark.parametrize("largest", [0, 60_000, 1 << 22], ids=["row by row", "some ahead", "whole"])
def test_the_samples_are_those_of_the_files(
    box: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, largest: int
) -> None:
    monkeypatch.setattr(ranges, "AHEAD_BYTES", largest)
    local = Pictures(open_shards(box))
    remote = Pictures(streamed(box, open_store("memory://"), tmp_path))
    same(remote, local)
    same([remote[k] for k in (5, 0, 3, 3)], [local[k] for k in (5, 0, 3, 3)])
    same(list(prefetched(remote, workers=4, ahead=4)), local)
    clouds = remote.clouds(64, noise="stereo", fuse=True)
    same(list(prefetched(clouds, workers=3)), local.clouds(64, noise="stereo", fuse=True))


def test_pictures_leave_nothing_on_the_disk(box: Path, shards: Shards, tmp_path: Path) -> None:
    assert sum(1 for _ in Pictures(shards)) == VIEWS
    (base,) = (tmp_path / "cache").iterdir()
    assert base.read_bytes() == (box / "base.h5").read_bytes()


def test_a_request_brings_what_is_read_in_turn(
    box: Path, shards: Shards, asked: list[tuple[str, int, int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    pictures = Pictures(shards, ["image/rgb", "image/depth"])
    pictures[0]
    asked.clear()
    shards.ranges.forget()
    assert sum(1 for _ in pictures) == VIEWS
    assert [key for key, _, _ in asked] == [VIEWS_KEY]
    monkeypatch.setattr(ranges, "GAP_BYTES", 0)
    shards.ranges.forget()
    asked.clear()
    pictures[4]
    size = (box / "views.h5").stat().st_size
    assert len(asked) == 2
    assert sum(length for _, _, length in asked) < size / VIEWS


def test_what_is_held_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    reader = ranges.RangeReader(open_store("memory://"))
    for number in range(6):
        reader._store.put(f"object-{number}", bytes(1000))
    monkeypatch.setattr(ranges, "HELD_BYTES", 2500)
    for number in range(6):
        reader.read(f"object-{number}", [(0, 1000)], 0, lambda row: [])
        assert sum(held.bytes for held in reader._objects.values()) <= 2500
    assert set(reader._objects) == {"object-4", "object-5"}


def turn_a_byte(path: Path) -> None:
    """Another byte in the depth of picture 2."""
    with h5py.File(path) as file:
        start, length = RowTable.of(file, ["image/depth"], "views").packed["image/depth"].places[2]
    data = bytearray(path.read_bytes())
    data[start + length // 2] ^= 0x10
    path.write_bytes(data)


@pytest.mark.parametrize("stream", [True, False])
def test_a_picture_whose_bytes_turned_is_refused_alone(box: Path, tmp_path: Path, stream: bool) -> None:
    copy = tmp_path / "store" / VIEWS_KEY if stream else tmp_path / "set" / "views.h5"
    if stream:
        shards = streamed(box, open_store(f"file://{tmp_path / 'store'}"), tmp_path / "cache")
    else:
        shutil.copytree(box, tmp_path / "set")
    turn_a_byte(copy)
    pictures = Pictures(shards if stream else open_shards(tmp_path / "set"), ["image/depth"])
    with pytest.raises(DamagedShard, match="row 2 of image/depth") as told:
        pictures[2]
    assert "\n" not in str(told.value)
    assert pictures[1]["image/depth"].shape == pictures[3]["image/depth"].shape
    if stream:
        copy.unlink()
        shards.ranges.forget()
        with pytest.raises(DamagedShard, match="is missing in the store"):
            pictures[1]


@pytest.mark.parametrize("largest", [0, 1 << 22], ids=["ranges", "whole"])
def test_a_store_that_is_away_is_told_and_not_taken_for_damage(
    shards: Shards, monkeypatch: pytest.MonkeyPatch, largest: int
) -> None:
    monkeypatch.setattr(ranges, "AHEAD_BYTES", largest)
    pictures = Pictures(shards)

    def away(*_: object) -> bytes:
        raise StoreUnavailable("the store is away")

    monkeypatch.setattr(Store, "get_range", away)
    shards.ranges.forget()
    with pytest.raises(StoreUnavailable, match="away"):
        pictures[0]


def test_a_kept_error_of_a_bad_shard_ends_the_process_well() -> None:
    """HDF5 crashes at the end of a process in which something still holds a file that it could not open."""
    code = """
from graspd.service.model.errors import InputError
from graspd.service.readers.ranges import RangeReader
from graspd.service.store.store import open_store
store = open_store("memory://")
store.put("shards/views/none.h5", bytes(100_000))
try:
    with RangeReader(store).open("shards/views/none.h5", whole=False):
        pass
except InputError as error:
    kept = error
    print(kept)
"""
    done = completed([sys.executable, "-c", code], cwd=REPOSITORY)
    assert (done.returncode, "not a readable HDF5 file" in done.stdout) == (0, True), done.stderr[-1000:]


def test_a_reader_begins_with_nothing_in_another_process(box: Path, tmp_path: Path) -> None:
    store = open_store(f"file://{tmp_path / 'store'}")
    pictures = Pictures(streamed(box, store, tmp_path / "cache"))
    first = pictures[3]
    again = pickle.loads(pickle.dumps(pictures))
    assert not again.shards.ranges._objects
    same([again[3]], [first])


@pytest.mark.parametrize("stream", [True, False])
def test_a_fork_is_told_to_start_anew(box: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stream: bool) -> None:
    remote = Store(MemoryStore(), "s3://bucket/graspd")
    shards = replace(streamed(box, remote, tmp_path), stream=stream)
    pictures = Pictures(shards)
    pictures[0]
    shards.ranges.forget()
    for path in tmp_path.iterdir():
        path.unlink()
    here = os.getpid()
    monkeypatch.setattr(os, "getpid", lambda: here + 1)
    with pytest.raises(InputError, match="spawn"):
        pictures[0]


def test_ranges_with_little_between_them_are_one() -> None:
    gap = ranges.GAP_BYTES
    assert ranges.joined([(gap + 15, 5), (0, 10), (10, 5)]) == [(0, gap + 20)]
    assert ranges.joined([(0, 10), (gap + 11, 5)]) == [(0, 10), (gap + 11, 5)]
    assert ranges.joined([(0, 100), (20, 10)]) == [(0, 100)]


def test_every_row_of_every_column_is_what_h5py_reads(box: Path) -> None:
    with h5py.File(box / "views.h5") as file:
        columns = [name for name in SCHEMAS["views"] if name in file]
        table = RowTable.of(file, columns, "views")
        assert {"image/rgb", "image/depth"} <= set(table.packed) and "camera/eye" in table.held
        for row in range(len(file["camera/eye"])):
            found = table.row(row, columns, lambda ranges: read_file(box / "views.h5", ranges))
            for name in columns:
                expected = file[name][row]
                assert found[name].dtype == expected.dtype
                np.testing.assert_array_equal(found[name], expected)


def test_what_is_packed_in_another_way_is_read_by_the_library(tmp_path: Path) -> None:
    values = np.arange(2 * 6 * 5, dtype=np.float32).reshape(2, 6, 5)
    ways = {
        "whole": {},
        "two": {"chunks": (2, 6, 5), "compression": "gzip"},
        "lzf": {"chunks": (1, 6, 5), "compression": "lzf"},
        "bare": {"chunks": (1, 6, 5)},
        "plain": {"chunks": (1, 6, 5), "compression": "gzip"},
        "summed": {"chunks": (1, 6, 5), "compression": "gzip", "fletcher32": True},
    }
    with h5py.File(tmp_path / "other.h5", "w") as file:
        for name, options in ways.items():
            file.create_dataset(name, data=values, **options)
        half = file.create_dataset("half", shape=values.shape, dtype="f4", chunks=(1, 6, 5), compression="gzip")
        half[1] = values[1]
    with h5py.File(tmp_path / "other.h5") as file:
        table = RowTable.of(file, [*ways, "half"], "other")
    assert set(table.packed) == {"plain"}
    found = table.row(1, ways, lambda ranges: read_file(tmp_path / "other.h5", ranges))
    for name in ways:
        np.testing.assert_array_equal(found[name], values[1])
    assert not table.row(0, ["half"], lambda _: [])["half"].any()


def test_a_file_that_ends_too_early_is_refused(box: Path, tmp_path: Path) -> None:
    with h5py.File(box / "views.h5") as file:
        table = RowTable.of(file, ["image/rgb"], "views")
    (tmp_path / "cut.h5").write_bytes((box / "views.h5").read_bytes()[:3000])
    with pytest.raises(DamagedShard, match="views is damaged"):
        table.row(1, ["image/rgb"], lambda ranges: read_file(tmp_path / "cut.h5", ranges))


def test_a_sample_is_the_callers_own(box: Path) -> None:
    pictures = Pictures(open_shards(box), ["image/rgb", "image/depth", "camera/intrinsics"])
    first = pictures[0]
    for value in first.values():
        if isinstance(value, np.ndarray):
            value[...] = 0
    assert pictures[0]["image/rgb"].any() and pictures[0]["camera/intrinsics"].any()
