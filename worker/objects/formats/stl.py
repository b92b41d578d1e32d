"""STL, binary and ASCII. A binary file is known by its length: its header may well begin with "solid"."""

from __future__ import annotations

import re

import numpy as np

from service.model.errors import MeshError
from worker.objects.formats.soup import Soup, check_face_count

_HEADER = 84
_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_FACET = re.compile(rb"\bfacet\s", re.IGNORECASE)
_LOOP = re.compile(rb"\bouter\s+loop\b", re.IGNORECASE)
_VERTEX = re.compile(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)", re.IGNORECASE)


def read(data: bytes) -> Soup:
    """Triangles of an STL file; each has its own three vertices."""
    if len(data) >= _HEADER and len(data) == _HEADER + _RECORD.itemsize * _promised(data):
        return _binary(data, _promised(data))
    if b"\0" not in data[:1024] and (_FACET.search(data) or b"endsolid" in data[-1024:].lower()):
        return _ascii(data)
    if len(data) < _HEADER:
        raise MeshError(f"{len(data)} bytes are too few for an STL file; it is truncated")
    if b"\0" not in data[:1024]:
        raise MeshError("neither binary STL nor text with facets; export the mesh again")
    held = (len(data) - _HEADER) / _RECORD.itemsize
    if _promised(data) > held:
        raise MeshError(f"truncated: the header promises {_promised(data)} faces, the file holds {int(held)}")
    # Some exporters append their own data: what the header promises is all there.
    return _binary(data, _promised(data))


def _promised(data: bytes) -> int:
    return int.from_bytes(data[80:84], "little")


def _binary(data: bytes, count: int) -> Soup:
    check_face_count(count)
    records = np.frombuffer(data, _RECORD, count=count, offset=_HEADER)
    return _soup(records["corners"].reshape(-1, 3).astype(float))


def _ascii(data: bytes) -> Soup:
    rows = _VERTEX.findall(data)
    check_face_count(len(rows) // 3)
    if len(rows) % 3:
        raise MeshError("truncated: the last facet has fewer than three vertices")
    if (loops := len(_LOOP.findall(data))) and 3 * loops != len(rows):
        raise MeshError("facets of more than three vertices; triangulate the mesh and export it again")
    return _soup(np.array(rows, dtype="S32").astype(float).reshape(-1, 3))


def _soup(corners: np.ndarray) -> Soup:
    return Soup(corners, np.arange(len(corners), dtype=np.int64).reshape(-1, 3))
