"""Rows of the columns of a shard without the HDF5 library: where each lies is asked once, then only its bytes are read.

A picture is one chunk of its column, packed by zlib. Opening a file and its datasets costs as much as unpacking a
picture does, and the library lets one thread work at a time; bytes are read and unpacked by any number of threads.
What was packed says by its checksum (Adler-32) whether it is what was written.
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np
from numpy.typing import NDArray

from service.model.errors import DamagedShard
from service.store.shards import read_column

Array = NDArray[Any]
#: (offset, length) pairs [bytes] to their bytes.
ReadRanges = Callable[[list[tuple[int, int]]], Sequence[bytes | memoryview]]

_SHUFFLE: Final = h5py.h5z.FILTER_SHUFFLE
_DEFLATE: Final = h5py.h5z.FILTER_DEFLATE


@dataclass(frozen=True)
class _Packed:
    """A column of which each row is a chunk of its own."""

    shape: tuple[int, ...]
    """Of a row."""
    dtype: np.dtype[Any]
    shuffled: bool
    places: NDArray[np.int64]
    """(rows, 2) offset and length in the file [bytes]."""

    def unpack(self, data: bytes | memoryview) -> Array:
        """The row that these bytes are; zlib.error, ValueError: they are none."""
        raw = np.frombuffer(zlib.decompress(data), np.uint8)
        size = self.dtype.itemsize
        if not self.shuffled or size == 1:
            return raw.copy().view(self.dtype).reshape(self.shape)
        turned = np.empty((len(raw) // size, size), np.uint8)
        for byte, column in enumerate(raw.reshape(size, -1)):  # one by one: twice as fast as transposing
            turned[:, byte] = column
        return turned.reshape(-1).view(self.dtype).reshape(self.shape)


@dataclass(frozen=True)
class RowTable:
    """Some columns of a shard: where the rows of the packed ones lie, and the values of all others."""

    name: str
    """What errors call the shard."""
    packed: dict[str, _Packed]
    held: dict[str, Array]

    @classmethod
    def of(cls, file: h5py.File, columns: Iterable[str], name: str) -> RowTable:
        """The columns of an open shard; of others than packed pictures the values are read and checked.

        Raises:
            DamagedShard: values are not those that were written.
        """
        packed, held = {}, {}
        for column in columns:
            found = _packed(file[column])
            if found is None:
                held[column] = read_column(file, column, name)
            else:
                packed[column] = found
        return cls(name, packed, held)

    @property
    def columns(self) -> set[str]:
        """What it knows of."""
        return {*self.packed, *self.held}

    def has(self, columns: Iterable[str]) -> bool:
        """Whether it knows of all of these."""
        return all(name in self.packed or name in self.held for name in columns)

    def ranges(self, row: int, columns: Iterable[str]) -> list[tuple[int, int]]:
        """Offset and length [bytes] in the file of a row of those columns that are packed; none past the last row."""
        found = (self.packed[name].places for name in columns if name in self.packed)
        return [(int(places[row, 0]), int(places[row, 1])) for places in found if row < len(places)]

    def row(self, row: int, columns: Iterable[str], read: ReadRanges) -> dict[str, Array]:
        """One row of some columns, for the caller to keep.

        Raises:
            DamagedShard: bytes are missing, or are not those that were written.
        """
        wanted = list(columns)
        packed = [name for name in wanted if name in self.packed]
        ranges = self.ranges(row, packed)
        found: dict[str, Array] = {name: np.array(self.held[name][row])[()] for name in wanted if name in self.held}
        for name, data in zip(packed, read(ranges) if ranges else [], strict=True):
            try:
                found[name] = self.packed[name].unpack(data)
            except (zlib.error, ValueError) as error:
                raise DamagedShard(f"{self.name} is damaged: row {row} of {name} cannot be read: {error}") from None
        return found


def read_file(path: Path, ranges: list[tuple[int, int]]) -> list[bytes]:
    """Bytes of a file."""
    handle = os.open(path, os.O_RDONLY)
    try:
        return [os.pread(handle, length, start) for start, length in ranges]
    finally:
        os.close(handle)


def _packed(dataset: h5py.Dataset) -> _Packed | None:
    """A column as `write_shard` packs pictures; None: it lies in the file in another way."""
    if dataset.chunks is None or dataset.chunks != (1, *dataset.shape[1:]):
        return None
    facts = dataset.id.get_create_plist()
    filters = [facts.get_filter(k)[0] for k in range(facts.get_nfilters())]
    rows = dataset.shape[0]
    if filters not in ([_SHUFFLE, _DEFLATE], [_DEFLATE]) or dataset.id.get_num_chunks() != rows:
        return None
    places = np.zeros((rows, 2), np.int64)
    rest = (0,) * (dataset.ndim - 1)
    for row in range(rows):
        found = dataset.id.get_chunk_info_by_coord((row, *rest))
        if found.filter_mask:  # a filter was left out for this chunk
            return None
        places[row] = found.byte_offset, found.size
    return _Packed(dataset.shape[1:], dataset.dtype, filters[0] == _SHUFFLE, places)
