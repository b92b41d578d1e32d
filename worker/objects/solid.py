"""Booleans and validity through manifold3d, in float64."""

from __future__ import annotations

from typing import Any, Final

import manifold3d
import numpy as np

from service.model.transforms import Floats
from worker.objects.topology import Indices, parts_of_graph

#: A gap exceeds its bound by more than this share of it: coordinates of files are rounded.
_ROUNDING: Final = 1e-3


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
    """Union of outward meshes less the holes (outward too); None if one of them is no solid.

    A part that lies within a hole is no part of what the hole is in: it stays.
    """
    solids: list[Any] = [to_manifold(*part) for part in parts]
    cuts: list[Any] = [to_manifold(*hole) for hole in holes]
    if any(solid is None for solid in solids + cuts):
        return None
    loose = [solid for solid in solids if any((solid - cut).is_empty() for cut in cuts)]
    result = union([solid for solid in solids if not any(solid is one for one in loose)])
    for cut in cuts:
        result -= cut
    return union([result, *loose]) if loose else result


def union(solids: list[Any]) -> Any:
    """All that one of the solids holds."""
    return manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add)


def groups(pieces: list[Any], gap: float) -> list[list[Any]]:
    """Solids that hang together over gaps of at most `gap`, the group of the largest volume first."""
    low, high = np.moveaxis(np.reshape([piece.bounding_box() for piece in pieces], (-1, 2, 3)), 1, 0)
    pairs = [
        (i, j)
        for i, piece in enumerate(pieces)
        for j in (i + 1 + np.flatnonzero(_apart(low, high, i) <= gap * (1 + _ROUNDING))).tolist()
        if piece.min_gap(pieces[j], 2 * gap) <= gap * (1 + _ROUNDING) and not _nested(piece, pieces[j])
    ]
    one, other = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    label = parts_of_graph(one, other, len(pieces))
    found = [[pieces[i] for i in np.flatnonzero(label == k)] for k in range(label.max() + 1)]
    return sorted(found, key=lambda group: -sum(piece.volume() for piece in group))


def _nested(a: Any, b: Any) -> bool:
    """Whether one of two outer shells holds the other: that one lies loose in a cavity."""
    small, large = sorted((a, b), key=lambda one: float(one.volume()))
    return bool((small - large).is_empty())


def _apart(low: Floats, high: Floats, i: int) -> Floats:
    """Gaps between box `i` and those after it."""
    return np.asarray(np.linalg.norm(np.maximum(0, np.maximum(low[i] - high[i + 1 :], low[i + 1 :] - high[i])), axis=1))
