"""PLY, ASCII and binary of both byte orders: positions and polygons; all other properties are stepped over."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

import numpy as np

from service.model.errors import MeshError
from worker.objects.formats.polygons import triangulate
from worker.objects.formats.soup import Soup, check_face_count

_TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
_MAX_ELEMENTS = 16


@dataclass
class _Property:
    name: str
    type: str
    count_type: str | None = None


@dataclass
class _Element:
    name: str
    count: int
    properties: list[_Property] = field(default_factory=list)


def read(data: bytes) -> Soup:
    """Vertices x y z and the polygons of `vertex_indices`."""
    found = re.search(rb"[\r\n]end_header", data[:65536])
    if not data.startswith(b"ply") or found is None:
        raise MeshError("a PLY file begins with the word ply and a header of at most 64 KiB")
    end, line_end = found.end(), _line_end(data[: found.end()])
    start = data.index(line_end, end) + len(line_end)
    order, elements = _header(data[:end].decode("ascii", "replace").splitlines()[1:])
    body = _Ascii(data[start:]) if order is None else _Binary(data[start:], order)
    vertices = np.zeros((0, 3))
    polygons = (np.zeros(0, np.int64), np.zeros(0, np.int64))
    for element in elements:
        scalars, lists = body.read(element)
        if element.name == "vertex":
            vertices = np.stack([scalars[axis].astype(float) for axis in "xyz"], axis=1)
        elif element.name == "face":
            name = next((p.name for p in element.properties if p.count_type and p.name.startswith("vertex_ind")), None)
            if name is None:
                raise MeshError("the faces have no list vertex_indices")
            polygons = lists[name]
    return Soup(vertices, triangulate(vertices, *polygons))


def _line_end(header: bytes) -> bytes:
    """How lines of the header end: what follows it may be binary and begin with any byte."""
    return next(end for end in (b"\r\n", b"\n", b"\r") if end in header)


def _header(lines: list[str]) -> tuple[str | None, list[_Element]]:
    """Byte order ("<", ">", None for ASCII) and the elements in the file's order."""
    order: str | None = ""
    elements: list[_Element] = []
    for line in lines:
        match line.split():
            case ["format", "ascii", *_]:
                order = None
            case ["format", "binary_little_endian", *_]:
                order = "<"
            case ["format", "binary_big_endian", *_]:
                order = ">"
            case ["element", name, count]:
                elements.append(_Element(name, int(count)))
                # Of a closed mesh there are about half as many vertices as faces.
                check_face_count(int(count) if name == "face" else int(count) // 4)
            case ["property", "list", count_type, type_, name]:
                elements[-1].properties.append(_Property(name, _TYPES[type_], _TYPES[count_type]))
            case ["property", type_, name]:
                elements[-1].properties.append(_Property(name, _TYPES[type_]))
    if order == "" or len(elements) > _MAX_ELEMENTS or any(e.count < 0 or not e.properties for e in elements):
        raise MeshError("the PLY header has no format, or elements without a count or properties")
    return order, elements


_Lists = dict[str, tuple[np.ndarray, np.ndarray]]


class _Ascii:
    """Reads one line per row."""

    def __init__(self, body: bytes) -> None:
        self._lines = [line for line in body.splitlines() if line.strip()]
        self._at = 0

    def read(self, element: _Element) -> tuple[dict[str, np.ndarray], _Lists]:
        rows = self._lines[self._at : self._at + element.count]
        if len(rows) < element.count:
            raise MeshError(f"truncated: {element.count} rows of {element.name} are promised, {len(rows)} are there")
        self._at += element.count
        if not any(p.count_type for p in element.properties):
            width = len(element.properties)
            table = np.array([row.split()[:width] for row in rows], dtype="S40").astype(float).reshape(-1, width)
            return {p.name: table[:, i] for i, p in enumerate(element.properties)}, {}
        counts: dict[str, list[int]] = {p.name: [] for p in element.properties if p.count_type}
        items: dict[str, list[int]] = {name: [] for name in counts}
        for row in rows:
            words = iter(row.split())
            for item in element.properties:
                if not item.count_type:
                    next(words, None)
                    continue
                values = [float(w) for _, w in zip(range(int(next(words, b""))), words, strict=False)]
                counts[item.name].append(len(values))
                items[item.name] += map(int, values)
        return {}, {n: (np.array(counts[n], dtype=np.int64), np.array(items[n], dtype=np.int64)) for n in counts}


class _Binary:
    """Reads rows of fixed width at once, rows with lists one by one."""

    def __init__(self, body: bytes, order: str) -> None:
        self._body = body
        self._order = order
        self._at = 0

    def read(self, element: _Element) -> tuple[dict[str, np.ndarray], _Lists]:
        lists = [p for p in element.properties if p.count_type]
        if not lists:
            table = self._take(np.dtype([(p.name, self._order + p.type) for p in element.properties]), element.count)
            return {p.name: table[p.name] for p in element.properties}, {}
        uniform = self._uniform(element) if len(lists) == 1 else None
        return {}, uniform if uniform is not None else self._row_by_row(element)

    def _uniform(self, element: _Element) -> _Lists | None:
        """All rows at once, if every list is as long as the first: the usual case of triangles only."""
        first = self._at
        (name,) = self._row_by_row(_Element(element.name, min(element.count, 1), element.properties)).items()
        self._at = first
        width = int(name[1][0][0]) if element.count else 0
        fields: list[tuple[str, str, tuple[int, ...]]] = []
        for p in element.properties:
            if p.count_type:
                fields.append((p.name + " count", self._order + p.count_type, ()))
            fields.append((p.name, self._order + p.type, (width,) if p.count_type else ()))
        dtype = np.dtype(fields)
        if dtype.itemsize * element.count > len(self._body) - self._at:
            return None
        table = np.frombuffer(self._body, dtype, count=element.count, offset=self._at)
        if not (table[name[0] + " count"] == width).all():
            return None
        self._at += dtype.itemsize * element.count
        return {name[0]: (np.full(element.count, width, np.int64), table[name[0]].reshape(-1).astype(np.int64))}

    def _row_by_row(self, element: _Element) -> _Lists:
        counts: dict[str, list[int]] = {p.name: [] for p in element.properties if p.count_type}
        items: dict[str, list[np.ndarray]] = {name: [] for name in counts}
        for _ in range(element.count):
            for p in element.properties:
                if p.count_type:
                    count = int(self._take(np.dtype(self._order + p.count_type), 1)[0])
                    counts[p.name].append(count)
                    items[p.name].append(self._take(np.dtype(self._order + p.type), count))
                else:
                    self._take(np.dtype(self._order + p.type), 1)
        empty = [np.zeros(0, np.int64)]
        return {
            n: (np.array(counts[n], dtype=np.int64), np.concatenate(empty + items[n]).astype(np.int64)) for n in counts
        }

    def _take(self, dtype: np.dtype, count: int) -> np.ndarray:
        if count < 0 or dtype.itemsize * count > len(self._body) - self._at:
            raise MeshError("truncated: the header promises more than the file holds")
        values = np.frombuffer(self._body, dtype, count=count, offset=self._at)
        self._at += dtype.itemsize * count
        return values
