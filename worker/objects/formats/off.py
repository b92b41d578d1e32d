"""OFF: the counts, the vertices, the polygons; colours, normals and texture coordinates are passed over."""

from __future__ import annotations

import re
from typing import Final

import numpy as np

from service.model.errors import MeshError
from worker.objects.formats.polygons import triangulate
from worker.objects.formats.soup import Soup, check_face_count

#: The word may have the counts glued to it (ModelNet40), and letters before it for what vertices have besides.
_HEAD: Final = re.compile(rb"(?:ST)?C?N?(4?n?)OFF(?![A-Z])(\s*BINARY)?", re.IGNORECASE)


def read(data: bytes) -> Soup:
    """Triangles of the polygons of an OFF file."""
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
        raise MeshError(f"truncated: {vertex_count} vertices and {face_count} faces are promised, not all are there")
    vertices = np.array([row[:3] for row in rows[1 : 1 + vertex_count]], dtype="S40").astype(float).reshape(-1, 3)
    counts: list[int] = []
    corners: list[int] = []
    for row in rows[1 + vertex_count : 1 + vertex_count + face_count]:
        count = int(row[0])
        if count < 0 or count > len(row) - 1:
            raise MeshError(f"face {len(counts)} promises {count} corners and has {len(row) - 1}")
        counts.append(count)
        corners += map(int, row[1 : 1 + count])
    return Soup(vertices, triangulate(vertices, np.array(counts, dtype=np.int64), np.array(corners, dtype=np.int64)))
