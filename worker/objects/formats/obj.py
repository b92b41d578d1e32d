"""Wavefront OBJ: positions and polygons; texture, normals, groups and materials are passed over."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from service.model.errors import MeshError
from worker.objects.formats.soup import Soup, check_face_count, fan


def read(data: bytes) -> Soup:
    """Polygons cut into fans; negative indices count from the latest vertex."""
    vertices: list[list[bytes]] = []
    corners: list[int] = []
    counts: list[int] = []
    for line in _lines(data):
        if line.startswith(b"v "):
            vertices.append(line.split(None, 4)[1:4])
            if len(vertices[-1]) < 3:
                raise MeshError(f"vertex {len(vertices)} has fewer than three coordinates")
        elif line.startswith(b"f "):
            # OBJ counts from 1, backwards from the end where the index is negative.
            face = [_index(part.partition(b"/")[0], len(vertices)) for part in line.split()[1:]]
            corners += face
            counts.append(len(face))
            if len(counts) % 65536 == 0:
                check_face_count(len(corners) - 2 * len(counts))
    points = np.array(vertices, dtype="S40").astype(float).reshape(-1, 3)
    return Soup(points, fan(np.array(counts, dtype=np.int64), np.array(corners, dtype=np.int64)))


def _index(text: bytes, count: int) -> int:
    index = int(text)
    if index == 0 or abs(index) > 2**40:
        raise MeshError(f"a face has the index {index}; OBJ indices count from 1")
    return index - 1 if index > 0 else count + index


def _lines(data: bytes) -> Iterable[bytes]:
    pending = b""
    for raw in data.splitlines():
        line = pending + raw.strip()
        if line.endswith(b"\\"):
            pending = line[:-1] + b" "
            if len(pending) > 2**20:
                raise MeshError("a continued line is longer than 1 MiB")
            continue
        pending = b""
        yield line.replace(b"\t", b" ")
