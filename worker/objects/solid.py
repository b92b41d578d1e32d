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
    result = manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add)
    for cut in cuts:
        result -= cut
    return result
