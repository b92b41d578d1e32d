"""Booleans and validity through manifold3d, in float64."""

from __future__ import annotations

from typing import Any

import manifold3d
import numpy as np

from worker.objects.topology import Floats, Indices


def to_manifold(vertices: Floats, faces: Indices) -> Any | None:
    """The mesh as a manifold3d solid, or None if it is no oriented 2-manifold."""
    mesh = manifold3d.Mesh64(
        np.array(vertices, dtype=np.float64, order="C"), np.array(faces, dtype=np.uint64, order="C")
    )
    solid = manifold3d.Manifold(mesh)
    if solid.status() != manifold3d.Error.NoError or solid.is_empty():
        return None
    return solid


def from_manifold(solid: Any) -> tuple[Floats, Indices]:
    """Vertices and faces of a solid."""
    mesh = solid.to_mesh64()
    return np.array(mesh.vert_properties, dtype=np.float64)[:, :3], np.array(mesh.tri_verts, dtype=np.int64)


def unite(parts: list[tuple[Floats, Indices]], holes: list[tuple[Floats, Indices]]) -> Any | None:
    """Union of outward meshes less the holes (outward too); None if one of them is no solid."""
    solids = [to_manifold(*part) for part in parts]
    cuts = [to_manifold(*hole) for hole in holes]
    if any(solid is None for solid in solids + cuts):
        return None
    result = union(solids)
    for cut in cuts:
        result -= cut
    return result


def union(solids: list[Any]) -> Any:
    """All that one of the solids holds."""
    return manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add)


def groups(pieces: list[Any], gap: float) -> list[list[Any]]:
    """Solids that hang together over gaps of at most `gap`, the group of the largest volume first."""
    left, found = list(pieces), []
    while left:
        group, waiting = [], [left.pop()]
        while waiting:
            group.append(waiting.pop())
            near = [one for one in left if _apart(group[-1], one) <= gap and group[-1].min_gap(one, 2 * gap) <= gap]
            left = [one for one in left if not any(one is other for other in near)]
            waiting += near
        found.append(group)
    return sorted(found, key=lambda group: -sum(one.volume() for one in group))


def _apart(a: Any, b: Any) -> float:
    """Gap between the boxes around two solids."""
    (low_a, high_a), (low_b, high_b) = (np.reshape(one.bounding_box(), (2, 3)) for one in (a, b))
    return float(np.linalg.norm(np.maximum(0, np.maximum(low_a - high_b, low_b - high_a))))
