"""Convex solids with few faces around convex pieces with many: what a hand stays clear of need not be finer."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from service.model.errors import MeshError
from service.model.transforms import Floats
from worker.hands.features import convex_edges
from worker.simulation.surroundings import Obstacle

#: Faces of a solid at most, and what it may stand out from its piece before it needs more [m].
MOST_PLANES: Final = 48
ENOUGH_M: Final = 1e-3
#: Corners nearer than this are one [m].
_SAME_M: Final = 1e-7


def outer_solid(corners: Floats, most: int = MOST_PLANES) -> tuple[Obstacle, float]:
    """A convex solid of at most `most` faces around points (V, 3).

    It begins as their box; then, as long as it stands out by more than `ENOUGH_M`, its farthest corner is cut off by
    the face of the points' hull which that corner lies farthest out of. It never cuts into the hull.

    Returns:
        The solid, and the farthest that it stands out from the points' hull [m].

    Raises:
        MeshError: the points lie in a plane.
    """
    from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError

    try:
        hull = ConvexHull(corners)
        faces = np.column_stack([hull.equations[:, :3], -hull.equations[:, 3]])
        planes = _box(corners)
        middle = corners[hull.vertices].mean(axis=0)
        found = HalfspaceIntersection(_as_qhull(planes), middle, incremental=True)
        while len(planes) < most:
            depth = found.intersections @ faces[:, :3].T - faces[:, 3]
            out = depth.max(axis=1)
            worst = int(np.argmax(out))
            if out[worst] <= ENOUGH_M:
                break
            planes = np.vstack([planes, faces[int(np.argmax(depth[worst]))]])
            found.add_halfspaces(_as_qhull(planes[-1:]))
        solid = Obstacle(planes, *_corners_and_edges(found.intersections))
        found.close()
    except QhullError:
        raise MeshError("a convex piece of this object is flat; an object needs some thickness") from None
    return solid, _stands_out(solid.corners, corners, hull)


def _box(corners: Floats) -> Floats:
    normals = np.concatenate([np.eye(3), -np.eye(3)])
    return np.column_stack([normals, (corners @ normals.T).max(axis=0)])


def _as_qhull(planes: Floats) -> Floats:
    """Rows n, -d of n.x - d <= 0."""
    return np.column_stack([planes[:, :3], -planes[:, 3]])


def _corners_and_edges(points: Floats) -> tuple[Floats, NDArray[np.intp]]:
    """Distinct corners of a convex solid and the edges between them."""
    from scipy.spatial import ConvexHull

    _, first = np.unique(np.round(points / _SAME_M).astype(np.int64), axis=0, return_index=True)
    hull = ConvexHull(points[np.sort(first)])
    kept = hull.vertices
    number = np.full(len(hull.points), -1)
    number[kept] = np.arange(len(kept))
    triangles = number[hull.simplices]
    corners = hull.points[kept]
    return corners, convex_edges(corners, _outward(corners, triangles, hull.equations[:, :3]))


def _outward(corners: Floats, triangles: NDArray[Any], normals: Floats) -> NDArray[Any]:
    """The triangles, turned round where they look inwards."""
    a, b, c = (corners[triangles[:, k]] for k in range(3))
    inward = (np.cross(b - a, c - a) * normals).sum(axis=1) < 0
    triangles[inward] = triangles[inward][:, ::-1]
    return triangles


def _stands_out(points: Floats, corners: Floats, hull: Any) -> float:
    """Farthest of `points` from the hull of `corners` [m]; on a convex solid no point is farther than a corner."""
    import trimesh  # slow to load, seldom needed

    mesh = trimesh.Trimesh(corners, hull.simplices, process=False)
    _, distance, _ = trimesh.proximity.closest_point_naive(mesh, points)
    outside = (points @ hull.equations[:, :3].T + hull.equations[:, 3]).max(axis=1) > 0
    return float(np.where(outside, distance, 0.0).max(initial=0.0))
