"""PLY (ASCII, binary of both byte orders), STL (binary, ASCII) and OFF, without normals.

Colours of a PLY are those of its faces, or else of most corners of a face. They select faces but are not drawn."""

import re
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from graspd.service.model.errors import MeshError
from graspd.worker.objects.formats.soup import Soup, check_face_count, triangulate

_NAMES = "char uchar short ushort int uint float double int8 uint8 int16 uint16 int32 uint32 float32 float64"
_TYPES = dict(zip(_NAMES.split(), 2 * ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"), strict=True))
_MAX_ELEMENTS = 16
_COLOURS: Final = ("red", "green", "blue")


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


def read_ply(data: bytes) -> Soup:
    found = re.search(rb"[\r\n]end_header", data[:65536])
    if not data.startswith(b"ply") or found is None:
        raise MeshError("a PLY file begins with the word ply and a header of at most 64 KiB")
    end = found.end()
    # Data after the header may be binary and begin with any byte.
    line_end = next(ending for ending in (b"\r\n", b"\n", b"\r") if ending in data[:end])
    start = data.index(line_end, end) + len(line_end)
    order, elements = _header(data[:end].decode("ascii", "replace").splitlines()[1:])
    body = _AsciiRows(data[start:]) if order is None else _BinaryRows(data[start:], order)
    vertices = np.zeros((0, 3))
    polygons = (np.zeros(0, np.int64), np.zeros(0, np.int64))
    of_vertices = of_faces = None
    for element in elements:
        scalars, lists = body.read(element)
        if element.name == "vertex":
            vertices = np.stack([scalars[axis].astype(float) for axis in "xyz"], axis=1)
            of_vertices = _colours(element, scalars)
        elif element.name == "face":
            name = next((p.name for p in element.properties if p.count_type and p.name.startswith("vertex_ind")), None)
            if name is None:
                raise MeshError("the faces have no list vertex_indices")
            polygons, of_faces = lists[name], _colours(element, scalars)
    faces = triangulate(vertices, *polygons)
    if of_faces is not None:
        return Soup(vertices, faces, paint=np.repeat(of_faces, np.maximum(polygons[0] - 2, 0), axis=0))
    if of_vertices is None or (faces < 0).any() or (faces >= len(vertices)).any():
        return Soup(vertices, faces)
    return Soup(vertices, faces, paint=np.median(of_vertices[faces], axis=1))


def _colours(element: _Element, scalars: dict[str, np.ndarray]) -> np.ndarray | None:
    """Return the sRGB colours (N, 3), 0 .. 1, of vertices or faces; None without colours."""
    if not all(name in scalars for name in _COLOURS):
        return None
    largest = {p.name: {"u1": 255.0, "u2": 65535.0}.get(p.type, 1.0) for p in element.properties}
    return np.clip(np.stack([scalars[name].astype(float) / largest[name] for name in _COLOURS], axis=1), 0, 1)


def _header(lines: list[str]) -> tuple[str | None, list[_Element]]:
    """Parse the byte order ("<", ">", None for ASCII) and the elements in the file's order."""
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
                # A closed mesh has about half as many vertices as faces.
                check_face_count(int(count) if name == "face" else int(count) // 4)
            case ["property", "list", count_type, type_, name]:
                elements[-1].properties.append(_Property(name, _TYPES[type_], _TYPES[count_type]))
            case ["property", type_, name]:
                elements[-1].properties.append(_Property(name, _TYPES[type_]))
    if order == "" or len(elements) > _MAX_ELEMENTS or any(e.count < 0 or not e.properties for e in elements):
        raise MeshError("the PLY header has no format, or elements without a count or properties")
    return order, elements


_Lists = dict[str, tuple[np.ndarray, np.ndarray]]


class _AsciiRows:
    """Reads rows of text."""

    def __init__(self, body: bytes) -> None:
        self._lines = [line for line in body.splitlines() if line.strip()]
        self._at = 0

    def read(self, element: _Element) -> tuple[dict[str, np.ndarray], _Lists]:
        rows = self._lines[self._at : self._at + element.count]
        if len(rows) < element.count:
            raise MeshError(f"truncated: {element.count} rows of {element.name} are stated, but {len(rows)} are there")
        self._at += element.count
        if not any(p.count_type for p in element.properties):
            width = len(element.properties)
            table = np.array([row.split()[:width] for row in rows], dtype="S40").astype(float).reshape(-1, width)
            return {p.name: table[:, i] for i, p in enumerate(element.properties)}, {}
        counts: dict[str, list[int]] = {p.name: [] for p in element.properties if p.count_type}
        items: dict[str, list[int]] = {name: [] for name in counts}
        scalars: dict[str, list[float]] = {p.name: [] for p in element.properties if p.name in _COLOURS}
        for row in rows:
            words = iter(row.split())
            for item in element.properties:
                if not item.count_type:
                    word = next(words, b"nan")
                    if item.name in scalars:
                        scalars[item.name].append(float(word))
                    continue
                values = [float(w) for _, w in zip(range(int(next(words, b""))), words, strict=False)]
                counts[item.name].append(len(values))
                items[item.name] += map(int, values)
        lists = {n: (np.array(counts[n], dtype=np.int64), np.array(items[n], dtype=np.int64)) for n in counts}
        return {n: np.array(values) for n, values in scalars.items()}, lists


class _BinaryRows:
    """Reads rows of equal width at once, and other rows one by one."""

    def __init__(self, body: bytes, order: str) -> None:
        self._body, self._order, self._at = body, order, 0

    def read(self, element: _Element) -> tuple[dict[str, np.ndarray], _Lists]:
        lists = [p for p in element.properties if p.count_type]
        if not lists:
            table = self._read_values(
                np.dtype([(p.name, self._order + p.type) for p in element.properties]), element.count
            )
            return {p.name: table[p.name] for p in element.properties}, {}
        uniform = self._read_uniform_rows(element) if len(lists) == 1 else None
        return uniform if uniform is not None else self._row_by_row(element)

    def _read_uniform_rows(self, element: _Element) -> tuple[dict[str, np.ndarray], _Lists] | None:
        """Read all rows at once if all lists are as long as the first, as in triangle meshes; else None."""
        first = self._at
        (name,) = self._row_by_row(_Element(element.name, min(element.count, 1), element.properties))[1].items()
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
        lists = {name[0]: (np.full(element.count, width, np.int64), table[name[0]].reshape(-1).astype(np.int64))}
        return {p.name: table[p.name] for p in element.properties if not p.count_type}, lists

    def _row_by_row(self, element: _Element) -> tuple[dict[str, np.ndarray], _Lists]:
        counts: dict[str, list[int]] = {p.name: [] for p in element.properties if p.count_type}
        items: dict[str, list[np.ndarray]] = {name: [] for name in counts}
        scalars: dict[str, list[np.ndarray]] = {p.name: [] for p in element.properties if not p.count_type}
        for _ in range(element.count):
            for p in element.properties:
                if p.count_type:
                    count = int(self._read_values(np.dtype(self._order + p.count_type), 1)[0])
                    counts[p.name].append(count)
                    items[p.name].append(self._read_values(np.dtype(self._order + p.type), count))
                else:
                    scalars[p.name].append(self._read_values(np.dtype(self._order + p.type), 1))
        empty = [np.zeros(0, np.int64)]
        lists = {n: (np.array(counts[n], np.int64), np.concatenate(empty + items[n]).astype(np.int64)) for n in counts}
        return {n: np.concatenate(empty + values) for n, values in scalars.items()}, lists

    def _read_values(self, dtype: np.dtype, count: int) -> np.ndarray:
        if count < 0 or dtype.itemsize * count > len(self._body) - self._at:
            raise MeshError("truncated: the header states more data than the file has")
        values = np.frombuffer(self._body, dtype, count=count, offset=self._at)
        self._at += dtype.itemsize * count
        return values


_HEADER = 84
_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_FACET = re.compile(rb"\bfacet\s", re.IGNORECASE)
_LOOP = re.compile(rb"\bouter\s+loop\b", re.IGNORECASE)
_VERTEX = re.compile(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)", re.IGNORECASE)


def read_stl(data: bytes) -> Soup:
    declared, held = int.from_bytes(data[80:84], "little"), (len(data) - _HEADER) / _RECORD.itemsize
    if held == declared:
        return _read_binary_stl(data, declared)
    if b"\0" not in data[:1024] and (_FACET.search(data) or b"endsolid" in data[-1024:].lower()):
        rows = _VERTEX.findall(data)
        check_face_count(len(rows) // 3)
        if len(rows) % 3:
            raise MeshError("truncated: the last facet has fewer than three vertices")
        if (loops := len(_LOOP.findall(data))) and 3 * loops != len(rows):
            raise MeshError("facets of more than three vertices; triangulate the mesh and export it again")
        return _soup(np.array(rows, dtype="S32").astype(float).reshape(-1, 3))
    if len(data) < _HEADER:
        raise MeshError(f"{len(data)} bytes are too few for an STL file; it is truncated")
    if b"\0" not in data[:1024]:
        raise MeshError("neither binary STL nor text with facets; export the mesh again")
    if declared > held:
        raise MeshError(f"truncated: the header states {declared} faces, but the file has {int(held)}")
    # Some exporters append their own data; all faces stated in the header are present.
    return _read_binary_stl(data, declared)


def _read_binary_stl(data: bytes, count: int) -> Soup:
    check_face_count(count)
    return _soup(np.frombuffer(data, _RECORD, count=count, offset=_HEADER)["corners"].reshape(-1, 3).astype(float))


def stl_bytes(vertices: np.ndarray, faces: np.ndarray) -> bytes:
    """Return a binary STL, without normals."""
    records = np.zeros(len(faces), _RECORD)
    records["corners"] = vertices[faces]
    return b"graspd".ljust(80) + len(faces).to_bytes(4, "little") + records.tobytes()


def _soup(corners: np.ndarray) -> Soup:
    return Soup(corners, np.arange(len(corners), dtype=np.int64).reshape(-1, 3))


#: The keyword may be joined with the counts (ModelNet40), and letters before it name further vertex data.
_HEAD: Final = re.compile(rb"(?:ST)?C?N?(4?n?)OFF(?![A-Z])(\s*BINARY)?", re.IGNORECASE)


def read_off(data: bytes) -> Soup:
    lines = [line for raw in data.splitlines() if (line := raw.partition(b"#")[0].strip())]
    head = _HEAD.match(lines[0]) if lines else None
    if head is None:
        raise MeshError("an OFF file begins with the word OFF")
    if head[1] or head[2]:
        raise MeshError(f"OFF of the kind {head[0].decode()} is not read; export plain OFF in text")
    lines[0] = lines[0][head.end() :].strip()
    rows = [line.split() for line in lines if line]
    if not rows or len(rows[0]) < 2:
        raise MeshError("truncated: the counts of vertices and faces are missing")
    vertex_count, face_count = int(rows[0][0]), int(rows[0][1])
    check_face_count(face_count)
    if min(vertex_count, face_count) < 0 or vertex_count + face_count > len(rows) - 1:
        raise MeshError(f"truncated: not all of the stated {vertex_count} vertices and {face_count} faces are present")
    vertices = np.array([row[:3] for row in rows[1 : 1 + vertex_count]], dtype="S40").astype(float).reshape(-1, 3)
    faces = rows[1 + vertex_count : 1 + vertex_count + face_count]
    counts = np.array([int(row[0]) for row in faces], dtype=np.int64)
    for number, (count, row) in enumerate(zip(counts, faces, strict=True)):
        if not 0 <= count < len(row):
            raise MeshError(f"face {number} states {count} corners but has {len(row) - 1}")
    corners = [int(word) for row in faces for word in row[1 : 1 + int(row[0])]]
    return Soup(vertices, triangulate(vertices, counts, np.array(corners, dtype=np.int64)))
