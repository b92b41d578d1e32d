"""Pictures read past the HDF5 library: the same values, and faults by name; a fork reads no remote store."""

from __future__ import annotations

import hashlib
import os
import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from obstore.store import MemoryStore

from graspd.service.model.errors import DamagedShard, InputError
from graspd.service.readers import Pictures, ShardCache, Shards, open_shards
from graspd.service.readers.rows import RowTable
from graspd.service.store.columns import SCHEMAS
from graspd.service.store.store import Store


def test_every_row_of_every_column_is_what_h5py_reads(box: Path) -> None:
    with h5py.File(box / "views.h5") as file:
        columns = [name for name in SCHEMAS["views"] if name in file]
        table = RowTable.of(file, columns, "views")
        assert {"image/rgb", "image/depth"} <= set(table.packed) and "camera/eye" in table.held
        for row in range(len(file["camera/eye"])):
            found = table.row(box / "views.h5", row, columns)
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
    found = table.row(tmp_path / "other.h5", 1, ways)
    for name in ways:
        np.testing.assert_array_equal(found[name], values[1])
    assert not table.row(tmp_path / "other.h5", 0, ["half"])["half"].any()


@pytest.mark.parametrize("harm", ["turned", "cut"])
def test_a_picture_whose_bytes_changed_is_refused_alone(box: Path, tmp_path: Path, harm: str) -> None:
    shutil.copytree(box, tmp_path / "set")
    pictures, path = Pictures(open_shards(tmp_path / "set"), ["image/depth"]), tmp_path / "set" / "views.h5"
    with h5py.File(path) as file:
        start, length = RowTable.of(file, ["image/depth"], "views").packed["image/depth"].places[2]
    data = bytearray(path.read_bytes())
    data[start + length // 2] ^= 0x10
    pictures[1]
    path.write_bytes(data if harm == "turned" else data[: start + length // 2])
    with pytest.raises(DamagedShard, match="row 2 of image/depth") as told:
        pictures[2]
    assert "\n" not in str(told.value)
    assert pictures[1]["image/depth"].any()


def test_a_sample_is_the_callers_own(box: Path) -> None:
    pictures = Pictures(open_shards(box), ["image/rgb", "image/depth", "camera/intrinsics"])
    first = pictures[0]
    for value in first.values():
        if isinstance(value, np.ndarray):
            value[...] = 0
    assert pictures[0]["image/rgb"].any() and pictures[0]["camera/intrinsics"].any()


def test_a_fork_is_told_to_start_anew(box: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    remote, files = Store(MemoryStore(), "s3://bucket/graspd"), []
    for file in open_shards(box):
        assert file.path is not None
        remote.put(key := f"shards/{file.kind}/{file.id}.h5", data := file.path.read_bytes())
        files.append(replace(file, path=None, key=key, sha256=hashlib.sha256(data).hexdigest()))
    pictures = Pictures(Shards(tuple(files), remote, ShardCache(tmp_path)))
    pictures[0]
    for path in tmp_path.iterdir():
        path.unlink()
    here = os.getpid()
    monkeypatch.setattr(os, "getpid", lambda: here + 1)
    with pytest.raises(InputError, match="spawn"):
        pictures[0]
