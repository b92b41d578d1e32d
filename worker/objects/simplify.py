"""Fewer faces within a stated error, never at the price of a hole."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from service.model.transforms import Floats
from worker.objects import solid, topology
from worker.objects.distance import MeshDistance, deviation, surface_points
from worker.objects.mass import signed_volume
from worker.objects.topology import Indices

Mesh = tuple[Floats, Indices]

#: Meshes with no more faces are left as they are: fewer would not make a query faster.
FEW_FACES: Final = 64
#: Meshes with more faces are first brought near this number.
MANY_FACES: Final = 40_000
#: The search stops when two targets differ by less than this factor.
STEP: Final = 1.12
#: Surface samples, besides the vertices, at which trials are held to a little less than the bound ...
SAMPLES: Final = 4000
MARGIN: Final = 0.9
#: ... and those at which the mesh that is returned is measured.
DENSE_SAMPLES: Final = 30_000
#: Aggressiveness of the collapse: the slowest that still reaches its target; it errs least and breaks least.
PATIENCE: Final = 3


def simplify(vertices: Floats, faces: Indices, error_m: float, *, closed: bool = True) -> tuple[Floats, Indices, float]:
    """The coarsest mesh found whose surface lies within `error_m` of the given one, both ways.

    Quadric edge collapse (Garland & Heckbert 1997) to a bisected number of faces; each trial is measured and, for
    closed meshes, must be an oriented 2-manifold with as many shells as the original. Where no trial passes, the mesh
    is thinned by manifold3d's edge collapse, and where that gains nothing it stays as it is.

    Returns:
        vertices, faces and the measured deviation [m].
    """
    if error_m <= 0 or len(faces) <= FEW_FACES:
        return vertices, faces, 0.0
    limit = MARGIN * error_m
    original = Original(vertices, faces, closed)
    if len(faces) > MANY_FACES:
        # A fifth of the error buys a mesh that is quick to compare with; by the triangle inequality the rest remains.
        start = _trial(original, MANY_FACES, limit / 5)
        if start is not None:
            original, limit = Original(*start, closed), limit * 4 / 5
    accepted: list[Mesh] = []
    low, high = float(FEW_FACES), float(len(original.faces))
    while high / low > STEP:
        target = round(math.sqrt(low * high))
        trial = _trial(original, target, limit)
        if trial is None:
            low = target
        else:
            high = target
            accepted.append(trial)
    if not accepted and closed:
        accepted = _thinned(original, limit)
    for mesh in reversed(accepted):
        error = deviation(mesh, (vertices, faces), DENSE_SAMPLES)
        if error <= error_m:
            return (*mesh, error)
    return vertices, faces, 0.0


class Original:
    """The mesh that trials are held against; what is asked of it many times is computed once."""

    def __init__(self, vertices: Floats, faces: Indices, closed: bool) -> None:
        self.vertices, self.faces, self.closed = vertices, faces, closed
        self.shells = int(topology.components(faces).max())
        self._distance = MeshDistance(vertices, faces)
        self._points = self._points_of((vertices, faces))

    def accepts(self, mesh: Mesh) -> bool:
        """Whether a mesh is closed, outward and in as many shells as the original, if that is closed."""
        if not self.closed:
            return True
        return (
            topology.is_closed(mesh[1])
            and signed_volume(*mesh) > 0
            and int(topology.components(mesh[1]).max()) == self.shells
            and solid.to_manifold(*mesh) is not None
        )

    def within(self, mesh: Mesh, limit: float) -> bool:
        """Whether the two surfaces lie within `limit` [m] of each other, both ways, over vertices and even samples."""
        back, own = MeshDistance(*mesh), self._points_of(mesh)
        # A few points tell of most meshes that are too coarse; all of them are only asked when it may be accepted.
        return all(
            float(distance(points[::step], limit).max()) <= limit
            for step in (16, 1)
            for distance, points in ((back, self._points), (self._distance, own))
        )

    @staticmethod
    def _points_of(mesh: Mesh) -> Floats:
        return surface_points(*mesh, SAMPLES)


def _trial(original: Original, target: int, error_m: float) -> Mesh | None:
    """A mesh of about `target` faces if it is sound and within the bound.

    A collapse that broke the surface at one count often does not at the next, so a few are tried.
    """
    for count in (target, int(target * 1.02) + 2, int(target * 1.05) + 4):
        mesh = _collapse(original.vertices, original.faces, count)
        if mesh is None or not original.accepts(mesh):
            continue
        return mesh if original.within(mesh, error_m) else None
    return None


def _collapse(vertices: Floats, faces: Indices, target: int) -> Mesh | None:
    if target >= len(faces):
        return None
    # Single precision inside: centred and scaled, so that it costs the least.
    middle, scale = vertices.mean(axis=0), float(np.ptp(vertices, axis=0).max())
    import fast_simplification  # where something is new on the machine

    points, triangles = fast_simplification.simplify(
        ((vertices - middle) / scale).astype(np.float32), faces.astype(np.int32), target_count=target, agg=PATIENCE
    )[:2]
    triangles = np.asarray(triangles, dtype=np.int64).reshape(-1, 3)
    triangles = triangles[(triangles != np.roll(triangles, 1, axis=1)).all(axis=1)]
    triangles = triangles[~topology.repeated(triangles)] if len(triangles) else triangles
    if len(triangles) < 4:
        return None
    mesh = topology.compact(np.asarray(points, dtype=float) * scale + middle, triangles)
    if (topology.edge_faces(mesh[1])[1] > 2).any():
        # A tunnel that collapsed to an edge: taking the edge apart closes the tunnel.
        mesh = topology.part_double_edges(*topology.split_edges(*mesh))
    return mesh


def _thinned(original: Original, error_m: float) -> list[Mesh]:
    whole = solid.to_manifold(original.vertices, original.faces)
    if whole is None:
        return []
    for share in (0.9, 0.5, 0.2):
        mesh = solid.from_manifold(whole.simplify(share * error_m))
        if len(mesh[1]) < len(original.faces) and original.accepts(mesh) and original.within(mesh, error_m):
            return [mesh]
    return []
