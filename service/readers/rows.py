"""Rows of a shard read without the HDF5 library, which runs only one thread at a time.

A picture is one zlib-compressed chunk of its column; its checksum (Adler-32) reveals damage.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np
from numpy.typing import NDArray

from graspd.service.model.errors import DamagedShard
from graspd.service.store.shards import read_column

Array = NDArray[Any]
_SHUFFLE: Final = h5py.h5z.FILTER_SHUFFLE
_DEFLATE: Final = h5py.h5z.FILTER_DEFLATE


@dataclass(frozen=True)
class _PackedColumn:
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    shuffled: bool
    places: NDArray[np.int64]
    """(rows, 2) offset and length of each row in the file [bytes]."""

    def unpack(self, data: bytes) -> Array:
        raw = np.frombuffer(zlib.decompress(data), np.uint8)
        size = self.dtype.itemsize
        if not self.shuffled or size == 1:
            return raw.copy().view(self.dtype).reshape(self.shape)
        turned = np.empty((len(raw) // size, size), np.uint8)
        for byte, column in enumerate(raw.reshape(size, -1)):  # One byte plane at a time: twice as fast as transposing.
            turned[:, byte] = column
        return turned.reshape(-1).view(self.dtype).reshape(self.shape)


@dataclass(frozen=True)
class RowTable:
    """Columns of a shard: file positions of the rows of packed columns, values of other columns."""

    name: str
    packed: dict[str, _PackedColumn]
    held: dict[str, Array]

    @classmethod
    def from_file(cls, file: h5py.File, columns: Iterable[str], name: str) -> RowTable:
        """Read the table of an open shard, and the verified values of columns that are not packed."""
        found = {column: _packed_column(file[column]) for column in columns}
        packed = {column: places for column, places in found.items() if places is not None}
        held = {column: read_column(file, column, name) for column in found.keys() - packed}
        return cls(name, packed, held)

    @property
    def columns(self) -> set[str]:
        return {*self.packed, *self.held}

    def row(self, path: Path, row: int, columns: Iterable[str]) -> dict[str, Array]:
        """Return one row of some columns of the file; DamagedShard if bytes are missing or damaged."""
        found: dict[str, Array] = {}
        with path.open("rb", buffering=0) as file:
            for name in columns:
                if name in self.held:
                    found[name] = np.array(self.held[name][row])[()]
                    continue
                start, length = self.packed[name].places[row]
                file.seek(start)
                try:
                    found[name] = self.packed[name].unpack(file.read(length))
                except (zlib.error, ValueError) as error:
                    problem = f"{self.name} is damaged: row {row} of {name} cannot be read: {error}"
                    raise DamagedShard(problem) from None
        return found


def _packed_column(dataset: h5py.Dataset) -> _PackedColumn | None:
    """Return a column in the layout in which `write_shard` packs pictures; None for another layout."""
    if dataset.chunks is None or dataset.chunks != (1, *dataset.shape[1:]):
        return None
    facts = dataset.id.get_create_plist()
    filters = [facts.get_filter(k)[0] for k in range(facts.get_nfilters())]
    rows = dataset.shape[0]
    if filters not in ([_SHUFFLE, _DEFLATE], [_DEFLATE]) or dataset.id.get_num_chunks() != rows:
        return None
    places = np.zeros((rows, 2), np.int64)
    for row in range(rows):
        found = dataset.id.get_chunk_info_by_coord((row, *(0,) * (dataset.ndim - 1)))
        if found.filter_mask:  # A filter was skipped for this chunk.
            return None
        places[row] = found.byte_offset, found.size
    return _PackedColumn(dataset.shape[1:], dataset.dtype, filters[0] == _SHUFFLE, places)
