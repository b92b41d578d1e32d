"""Reader of pictures in a store by byte ranges: read-ahead, no HDF5 library, no disk cache.

A picture is one zlib-compressed chunk of its column; its checksum (Adler-32) reveals damage. Any number of threads can
read and unpack byte ranges, whereas the HDF5 library runs only one thread at a time.
"""

from __future__ import annotations

import io
import os
import threading
import zlib
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np
from numpy.typing import NDArray

from graspd.service.model.errors import DamagedShard, GraspdError, NotFoundError
from graspd.service.readers.cache import check_not_forked
from graspd.service.store.integrity import gone
from graspd.service.store.shards import open_shard, read_column
from graspd.service.store.store import Store

#: Offset and length [bytes]; offset and the bytes from this offset.
Range = tuple[int, int]
Span = tuple[int, memoryview]
#: Largest request when pictures are read in sequence [bytes]; a smaller shard is read whole.
AHEAD_BYTES: Final = 4 << 20
#: Memory limit for the bytes of all shards [bytes].
HELD_BYTES: Final = 64 << 20
_OBJECTS: Final = 256
#: Ranges at most this far apart are merged into one request [bytes]: reading the gap costs less than a request.
GAP_BYTES: Final = 1 << 16
#: Block size for HDF5 metadata [bytes], which lies at the beginning and scattered in the file.
_BLOCK_BYTES: Final = 1 << 14
#: Tolerance in rows for reading in sequence: several threads request pictures only nearly in order.
_NEARLY: Final = 16


class RangeReader:
    """Byte ranges of the objects of a store. Thread-safe; a copy in another process starts empty."""

    def __init__(self, store: Store) -> None:
        self._store, self._process = store, os.getpid()
        self._objects: OrderedDict[str, _Object] = OrderedDict()
        self._lock = threading.Lock()

    def __reduce__(self) -> tuple[type[RangeReader], tuple[Store]]:
        return RangeReader, (self._store,)

    @contextmanager
    def open(self, key: str, *, whole: bool) -> Iterator[h5py.File]:
        """Open the HDF5 file of a shard; `whole`: pictures too, so a small shard is read at once."""
        held = self._of(key)
        with held.lock:
            if not held.size:
                with self._reading(key):
                    held.size = self._store.size(key)
            small = whole and held.size <= AHEAD_BYTES
            if small and not _covers(held.spans, (0, held.size)):
                held.spans = [self._get(key, (0, held.size))]
            source = _Source(held.size, held.spans if small else [], lambda span: self._get(key, span))
        self._make_room(key)
        opened, problem = False, None
        try:
            with open_shard(source, name=self._name(key)) as file:
                opened = True
                yield file
        except GraspdError as error:
            if opened and source.failed is None:
                raise
            # HDF5 reports only a failed read; the store's error has the reason. Raise a new error: a reference to the
            # old one keeps objects alive that HDF5 could not open, which crashes at exit (h5py 3.16).
            told = source.failed or error
            problem = type(told)(*told.args)
            del told
        if problem is not None:
            raise problem

    def read(self, key: str, wanted: Sequence[Range], row: int, further: Callable[[int], Sequence[Range]]) -> list[Any]:
        """Return the bytes of some ranges of a row; `further` returns another row's ranges, none after the last row."""
        held = self._of(key)
        with held.lock:
            if not all(_covers(held.spans, one) for one in wanted):
                in_turn = row == 0 if held.row is None else 0 < abs(row - held.row) <= _NEARLY
                ranges = list(wanted)
                bytes_, next_row = sum(length for _, length in ranges), row + 1
                while in_turn and (more := further(next_row)) and bytes_ < AHEAD_BYTES:
                    ranges += more
                    bytes_, next_row = bytes_ + sum(length for _, length in more), next_row + 1
                held.spans = [self._get(key, one) for one in joined(ranges)]
            held.row = row
            found = [_cut(held.spans, one) for one in wanted]
        self._make_room(key)
        return found

    def forget(self) -> None:
        with self._lock:
            self._objects.clear()

    def _of(self, key: str) -> _Object:
        with self._lock:
            held = self._objects.setdefault(key, _Object())
            self._objects.move_to_end(key)
            return held

    def _make_room(self, key: str) -> None:
        with self._lock:
            used = sum(held.bytes for held in self._objects.values())
            for other in list(self._objects):
                if used <= HELD_BYTES and len(self._objects) <= _OBJECTS:
                    return
                if other != key:
                    used -= self._objects.pop(other).bytes

    def _get(self, key: str, one: Range) -> Span:
        with self._reading(key):
            return one[0], memoryview(self._store.get_range(key, *one))

    @contextmanager
    def _reading(self, key: str) -> Iterator[None]:
        check_not_forked(self._store, self._process)
        try:
            yield
        except NotFoundError:
            raise gone(self._name(key)) from None

    def _name(self, key: str) -> str:
        return f"{self._store.url}/{key}"


@dataclass
class _Object:
    lock: threading.Lock = field(default_factory=threading.Lock)
    size: int = 0
    spans: list[Span] = field(default_factory=list)
    row: int | None = None

    @property
    def bytes(self) -> int:
        return sum(len(data) for _, data in self.spans)


class _Source(io.RawIOBase):
    """File object for HDF5 over an object of the store, partly cached."""

    def __init__(self, size: int, spans: Sequence[Span], get: Callable[[Range], Span]) -> None:
        super().__init__()
        self._size, self._spans, self._get, self._at = size, list(spans), get, 0
        self.failed: GraspdError | None = None

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._at

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        self._at = offset + (0, self._at, self._size)[whence]
        return self._at

    def readinto(self, buffer: Any) -> int:
        view = memoryview(buffer).cast("B")
        wanted = (self._at, min(len(view), max(self._size - self._at, 0)))
        if not _covers(self._spans, wanted):
            first = wanted[0] // _BLOCK_BYTES * _BLOCK_BYTES
            last = min(-(-sum(wanted) // _BLOCK_BYTES) * _BLOCK_BYTES, self._size)
            try:
                self._spans.append(self._get((first, last - first)))
            except GraspdError as error:
                # HDF5 would print an exception from here and continue. Zeros make it stop, because it cannot parse
                # them.
                self.failed = error.with_traceback(None)
                self._spans.append((first, memoryview(bytes(last - first))))
        data = _cut(self._spans, wanted)
        view[: len(data)] = data
        self._at += len(data)
        return len(data)


def joined(ranges: Sequence[Range]) -> list[Range]:
    found: list[Range] = []
    for start, length in sorted(ranges):
        if found and start - sum(found[-1]) <= GAP_BYTES:
            begin = found[-1][0]
            found[-1] = (begin, max(sum(found[-1]), start + length) - begin)
        else:
            found.append((start, length))
    return found


def _covers(spans: Sequence[Span], one: Range) -> bool:
    return any(start <= one[0] and sum(one) <= start + len(data) for start, data in spans)


def _cut(spans: Sequence[Span], one: Range) -> memoryview:
    """Return the bytes of a range from the span that covers most of it; fewer if the object ends early."""
    parts = [data[one[0] - start : sum(one) - start] for start, data in spans if start <= one[0]]
    return max(parts, key=len, default=memoryview(b""))


Array = NDArray[Any]
#: Function from (offset, length) pairs [bytes] to their bytes.
ReadRanges = Callable[[list[tuple[int, int]]], Sequence[bytes | memoryview]]

_SHUFFLE: Final = h5py.h5z.FILTER_SHUFFLE
_DEFLATE: Final = h5py.h5z.FILTER_DEFLATE


@dataclass(frozen=True)
class _Packed:
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    shuffled: bool
    places: NDArray[np.int64]
    """(rows, 2) offset and length in the file [bytes]."""

    def unpack(self, data: bytes | memoryview) -> Array:
        raw = np.frombuffer(zlib.decompress(data), np.uint8)
        size = self.dtype.itemsize
        if not self.shuffled or size == 1:
            return raw.copy().view(self.dtype).reshape(self.shape)
        turned = np.empty((len(raw) // size, size), np.uint8)
        for byte, column in enumerate(raw.reshape(size, -1)):  # one byte plane at a time: twice as fast as transposing
            turned[:, byte] = column
        return turned.reshape(-1).view(self.dtype).reshape(self.shape)


@dataclass(frozen=True)
class RowTable:
    """Columns of a shard: file positions of the rows in packed columns, values of other columns."""

    name: str
    packed: dict[str, _Packed]
    held: dict[str, Array]

    @classmethod
    def of(cls, file: h5py.File, columns: Iterable[str], name: str) -> RowTable:
        """Read the table of an open shard; values of columns that are not packed are read and checked."""
        found = {column: _packed(file[column]) for column in columns}
        packed = {column: places for column, places in found.items() if places is not None}
        held = {column: read_column(file, column, name) for column in found.keys() - packed}
        return cls(name, packed, held)

    @property
    def columns(self) -> set[str]:
        return {*self.packed, *self.held}

    def ranges(self, row: int, columns: Iterable[str]) -> list[tuple[int, int]]:
        """Return offset and length [bytes] of a row in each packed column; empty after the last row."""
        found = (self.packed[name].places for name in columns if name in self.packed)
        return [(int(places[row, 0]), int(places[row, 1])) for places in found if row < len(places)]

    def row(self, row: int, columns: Iterable[str], read: ReadRanges) -> dict[str, Array]:
        """Return one row of some columns, owned by the caller; DamagedShard if bytes are missing or damaged."""
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
    handle = os.open(path, os.O_RDONLY)
    try:
        return [os.pread(handle, length, start) for start, length in ranges]
    finally:
        os.close(handle)


def _packed(dataset: h5py.Dataset) -> _Packed | None:
    """Return a column packed as `write_shard` packs pictures; None if its layout differs."""
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
        if found.filter_mask:  # a filter was skipped for this chunk
            return None
        places[row] = found.byte_offset, found.size
    return _Packed(dataset.shape[1:], dataset.dtype, filters[0] == _SHUFFLE, places)
