"""Fewer faces within a stated error, never at the price of a hole."""

from __future__ import annotations

import math
from typing import Final

import fast_simplification
import numpy as np

from worker.objects import solid, topology
from worker.objects.distance import deviation
from worker.objects.mass import signed_volume
from worker.objects.topology import Floats, Indices

Mesh = tuple[Floats, Indices]

#: Meshes with no more faces are left as they are: fewer would not make a query faster.
FEW_FACES: Final = 64
#: The search stops when two targets differ by less than this factor.
STEP: Final = 1.12


def simplify(vertices: Floats, faces: Indices, error_m: float, *, closed: bool = True) -> tuple[Floats, Indices, float]:
    """The coarsest mesh found whose surface lies within `error_m` of the given one, both ways.

    Quadric edge collapse (Garland & Heckbert 1997) to a bisected number of faces; each trial is measured and, for
    closed meshes, must be an oriented 2-manifold of the same genus and components. Where no trial passes, the mesh is
    thinned by manifold3d's edge collapse, and where that gains nothing it stays as it is.

    Returns:
        vertices, faces and the measured deviation [m].
    """
    if error_m <= 0 or len(faces) <= FEW_FACES:
        return vertices, faces, 0.0
    best: tuple[Floats, Indices, float] | None = None
    low, high = float(min(FEW_FACES, len(faces))), float(len(faces))
    while high / low > STEP:
        target = round(math.sqrt(low * high))
        trial = _trial(vertices, faces, target, error_m, closed)
        if trial is None:
            low = target
        else:
            high, best = target, trial
    if best is None and closed:
        best = _thinned(vertices, faces, error_m)
    return best if best is not None else (vertices, faces, 0.0)


def _trial(
    vertices: Floats, faces: Indices, target: int, error_m: float, closed: bool
) -> tuple[Floats, Indices, float] | None:
    """A mesh of about `target` faces if it keeps the topology and the bound. A broken one gets a second chance."""
    for count in (target, int(target * 1.03) + 2):
        mesh = _collapse(vertices, faces, count)
        if mesh is None or (closed and not same_topology(mesh, (vertices, faces))):
            continue
        error = deviation(mesh, (vertices, faces))
        return (*mesh, error) if error <= error_m else None
    return None


def _collapse(vertices: Floats, faces: Indices, target: int) -> Mesh | None:
    # Single precision inside: centred and scaled, so that it costs the least.
    middle, scale = vertices.mean(axis=0), float(np.ptp(vertices, axis=0).max())
    points, triangles = fast_simplification.simplify(
        ((vertices - middle) / scale).astype(np.float32), faces.astype(np.int32), target_count=target
    )
    triangles = np.asarray(triangles, dtype=np.int64).reshape(-1, 3)
    if len(triangles) < 4:
        return None
    points, triangles = topology.compact(np.asarray(points, dtype=float) * scale + middle, triangles)
    keep = ~((triangles == np.roll(triangles, 1, axis=1)).any(axis=1) | topology.repeated(triangles))
    return topology.compact(points, triangles[keep]) if keep.sum() >= 4 else None


def same_topology(mesh: Mesh, original: Mesh) -> bool:
    """Whether a mesh is closed and outward with the original's Euler characteristic and number of shells."""
    if not topology.is_closed(mesh[1]) or signed_volume(*mesh) <= 0:
        return False
    if _euler(mesh) != _euler(original) or topology.components(mesh[1]).max() != topology.components(original[1]).max():
        return False
    return solid.to_manifold(*mesh) is not None


def _euler(mesh: Mesh) -> int:
    """V - E + F, with E = 3/2 F on closed meshes."""
    return len(np.unique(mesh[1])) - len(mesh[1]) // 2


def _thinned(vertices: Floats, faces: Indices, error_m: float) -> tuple[Floats, Indices, float] | None:
    original = solid.to_manifold(vertices, faces)
    if original is None:
        return None
    for share in (0.9, 0.5, 0.2):
        mesh = solid.from_manifold(original.simplify(share * error_m))
        if len(mesh[1]) < len(faces) and same_topology(mesh, (vertices, faces)):
            error = deviation(mesh, (vertices, faces))
            if error <= error_m:
                return (*mesh, error)
    return None
