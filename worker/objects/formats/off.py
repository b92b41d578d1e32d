"""OFF: the counts, the vertices, the polygons; colours are passed over."""

from __future__ import annotations

import numpy as np

from service.model.errors import MeshError
from worker.objects.formats.soup import Soup, check_face_count, fan


def read(data: bytes) -> Soup:
    """Polygons of an OFF file cut into fans."""
    lines = [line for raw in data.splitlines() if (line := raw.partition(b"#")[0].split())]
    if not lines or not lines[0][0].upper().endswith(b"OFF"):
        raise MeshError("an OFF file begins with the word OFF")
    # "OFF 8 6 0" on one line is as common as the counts on the next.
    head = lines[0][1:] if len(lines[0]) > 1 else lines.pop(1) if len(lines) > 1 else []
    if len(head) < 2:
        raise MeshError("truncated: the counts of vertices and faces are missing")
    vertex_count, face_count = int(head[0]), int(head[1])
    check_face_count(face_count)
    if min(vertex_count, face_count) < 0 or vertex_count + face_count > len(lines) - 1:
        raise MeshError(f"truncated: {vertex_count} vertices and {face_count} faces are promised, not all are there")
    vertices = np.array([line[:3] for line in lines[1 : 1 + vertex_count]], dtype="S40").astype(float).reshape(-1, 3)
    counts: list[int] = []
    corners: list[int] = []
    for line in lines[1 + vertex_count : 1 + vertex_count + face_count]:
        count = int(line[0])
        if count < 0 or count > len(line) - 1:
            raise MeshError(f"face {len(counts)} promises {count} corners and has {len(line) - 1}")
        counts.append(count)
        corners += map(int, line[1 : 1 + count])
    return Soup(vertices, fan(np.array(counts, dtype=np.int64), np.array(corners, dtype=np.int64)))
