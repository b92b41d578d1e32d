"""Self-intersections of a surface, and their removal such that the overlap counts once."""

from typing import Any, Final

import manifold3d
import numpy as np
from numpy.typing import NDArray

from graspd.service.model.transforms import Floats
from graspd.worker.objects import mesh_geometry, topology
from graspd.worker.objects.distance import MeshDistance, subdivide_triangles, surface_points
from graspd.worker.objects.mesh_geometry import signed_volume
from graspd.worker.objects.topology import Indices

Mesh = tuple[Floats, Indices]

#: Largest number of faces of a searched mesh: a larger search would cost more than all other steps.
MAX_FACES: Final = 120_000
#: Largest number of pairs of near pieces; bounds memory and time.
MAX_PAIRS: Final = 6_000_000
#: An edge crosses a face if it extends beyond both sides by this share of the mesh's extent; touching does not count.
DEPTH: Final = 1e-6
#: Least distance of a crossing from the face's rim, as a share of its height, so that edges that meet do not cross.
_RIM: Final = 1e-6
#: Halvings of a self-intersecting piece before the attempt ends.
_HALVINGS: Final = 7
#: A repair is safe if the new surface lies on the old one within this share of the extent.
_SAME: Final = 1e-5
_SAMPLES: Final = 4000
_CHUNK: Final = 200_000


def intersecting_faces(vertices: Floats, faces: Indices) -> Indices | None:
    """Find pairs (P, 2) of intersecting faces without common vertex; None if the mesh is too large.
    The broad phase cuts faces into small pieces, and keeps faces with overlapping boxes and bounding balls of pieces.
    The narrow phase keeps pairs in which an edge of one face passes through the interior of the other."""
    from scipy.spatial import cKDTree

    if len(faces) > MAX_FACES:
        return None
    corners = vertices[faces]
    # Pieces may be much longer than the edges of an even mesh of so many faces: only long faces are cut.
    centres, radius, owner = subdivide_triangles(corners, 4, max(len(faces), 2000))
    tree = cKDTree(centres)
    if tree.count_neighbors(tree, 2 * radius) > 2 * MAX_PAIRS:
        return None
    near = owner[tree.query_pairs(2 * radius, output_type="ndarray")]
    pairs = near[(near[:, 0] != near[:, 1]) & _box_overlap_mask(corners, near)]
    # Each unordered pair counts once; pairs encoded as one number sort many times faster than rows.
    keys = np.unique(pairs.min(axis=1) * np.int64(len(faces)) + pairs.max(axis=1))
    near = np.stack(np.divmod(keys, len(faces)), axis=1)
    apart = ~(faces[near[:, 0]][:, :, None] == faces[near[:, 1]][:, None, :]).any(axis=(1, 2))
    near = near[apart]
    depth = DEPTH * float(np.ptp(vertices, axis=0).max())
    found = [
        _edge_crossing_mask(corners[part[:, 0]], corners[part[:, 1]], depth)
        | _edge_crossing_mask(corners[part[:, 1]], corners[part[:, 0]], depth)
        for part in np.array_split(near, max(1, len(near) // _CHUNK))
    ]
    return near[np.concatenate(found)]


def _box_overlap_mask(corners: Floats, pairs: Indices) -> NDArray[np.bool_]:
    low, high = corners.min(axis=1), corners.max(axis=1)
    one, other = pairs.T
    return np.asarray(((low[one] <= high[other]) & (low[other] <= high[one])).all(axis=1))


def _edge_crossing_mask(edges_of: Floats, triangles: Floats, depth: float) -> NDArray[np.bool_]:
    """Return a mask (P,): an edge of one triangle (P, 3, 3) passes `depth` [m] deep through the other."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    normal = np.cross(b - a, c - a)
    square = np.maximum(np.einsum("ij,ij->i", normal, normal), 1e-300)
    height = np.einsum("pkj,pj->pk", edges_of - a[:, None], normal) / np.sqrt(square)[:, None]
    hit = np.zeros(len(triangles), dtype=bool)
    for k in range(3):
        start, end = height[:, k], height[:, (k + 1) % 3]
        (row,) = np.nonzero((start * end < 0) & (np.minimum(np.abs(start), np.abs(end)) > depth))
        t = start[row] / (start[row] - end[row])
        first, second = b[row] - a[row], c[row] - a[row]
        begin, finish = edges_of[row, k], edges_of[row, (k + 1) % 3]
        point = begin + t[:, None] * (finish - begin) - a[row]
        v = np.einsum("ij,ij->i", np.cross(point, second), normal[row]) / square[row]
        w = np.einsum("ij,ij->i", np.cross(first, point), normal[row]) / square[row]
        hit[row] |= (v > _RIM) & (w > _RIM) & (v + w < 1 - _RIM)
    return hit


def unite_self_overlaps(vertices: Floats, faces: Indices) -> Mesh | None:
    """Return the solid in which doubly enclosed volume counts once; None if this is not safe.
    The mesh is halved until no piece intersects itself, and the pieces are united; no vertex moves. This is safe if the
    result is closed and free of crossings, and all of its surface lies on the old surface."""
    whole = mesh_geometry.to_manifold(vertices, faces)
    pieces = None if whole is None else _split_recursively(whole, _HALVINGS)
    if pieces is None:
        return None
    united = topology.from_manifold(manifold3d.Manifold.batch_boolean(pieces, manifold3d.OpType.Add))
    extent = float(np.ptp(vertices, axis=0).max())
    united = topology.drop_unused_vertices(*topology.merge_vertices(*united, 1e-9 * extent))
    left = intersecting_faces(*united) if topology.is_closed(united[1]) else None
    if left is None or len(left) or not 0 < signed_volume(*united) <= signed_volume(vertices, faces):
        return None
    strayed = MeshDistance(vertices, faces).largest(surface_points(*united, _SAMPLES))
    return united if strayed <= _SAME * extent else None


def _split_recursively(piece: Any, halvings: int) -> list[Any] | None:
    """Cut a solid into parts that do not intersect themselves; None if this takes too many cuts."""
    parts: list[Any] = []
    for part in piece.decompose():
        mesh = topology.from_manifold(part)
        crossed = intersecting_faces(*mesh)
        if crossed is None or part.volume() <= 0:
            return None
        if not len(crossed):
            parts.append(part)
            continue
        if not halvings:
            return None
        middles = mesh[0][mesh[1][crossed.reshape(-1)]].mean(axis=1)
        axis = np.eye(3)[int(np.argmax(np.ptp(mesh[0], axis=0)))]
        for half in part.split_by_plane(tuple(axis), float(np.median(middles @ axis))):
            more = [] if half.is_empty() else _split_recursively(half, halvings - 1)
            if more is None:
                return None
            parts += more
    return parts
