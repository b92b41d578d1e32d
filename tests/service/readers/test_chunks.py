"""Rows read past the HDF5 library are those that it reads, and damage is told."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from graspd.service.model.errors import DamagedShard
from graspd.service.readers import Pictures, open_shards
from graspd.service.readers.ranges import RowTable, read_file
from graspd.service.store.columns import SCHEMAS
from tests.service.readers import box_scenes


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return box_scenes.write(tmp_path_factory.mktemp("box")) / "views.h5"


def test_every_row_of_every_column_is_what_h5py_reads(views: Path) -> None:
    with h5py.File(views) as file:
        columns = [name for name in SCHEMAS["views"] if name in file]
        table = RowTable.of(file, columns, "views")
        assert {"image/rgb", "image/depth"} <= set(table.packed) and "camera/eye" in table.held
        for row in range(len(file["camera/eye"])):
            found = table.row(row, columns, lambda ranges: read_file(views, ranges))
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


def test_a_picture_whose_bytes_turned_is_refused_and_the_others_are_read(views: Path, tmp_path: Path) -> None:
    folder = tmp_path / "set"
    folder.mkdir()
    (folder / "base.h5").write_bytes((views.parent / "base.h5").read_bytes())
    with h5py.File(views) as file:
        start, length = RowTable.of(file, ["image/depth"], "views").packed["image/depth"].places[2]
    data = bytearray(views.read_bytes())
    data[start + length // 2] ^= 0x10
    (folder / "views.h5").write_bytes(data)
    pictures = Pictures(open_shards(folder), ["image/depth"])
    with pytest.raises(DamagedShard, match="row 2 of image/depth") as told:
        pictures[2]
    assert "\n" not in str(told.value)
    assert pictures[1]["image/depth"].shape == pictures[3]["image/depth"].shape


def test_a_file_that_ends_too_early_is_refused(views: Path, tmp_path: Path) -> None:
    with h5py.File(views) as file:
        table = RowTable.of(file, ["image/rgb"], "views")
    (tmp_path / "cut.h5").write_bytes(views.read_bytes()[:3000])
    with pytest.raises(DamagedShard, match="views is damaged"):
        table.row(1, ["image/rgb"], lambda ranges: read_file(tmp_path / "cut.h5", ranges))


def test_a_sample_is_the_callers_own(views: Path) -> None:
    pictures = Pictures(open_shards(views.parent), ["image/rgb", "image/depth", "camera/intrinsics"])
    first = pictures[0]
    for value in first.values():
        if isinstance(value, np.ndarray):
            value[...] = 0
    assert pictures[0]["image/rgb"].any() and pictures[0]["camera/intrinsics"].any()
