"""Topology of a triangle mesh: merging, degenerate and duplicate faces, winding, edges, components.

All functions are pure: vertices (V, 3) and faces (F, 3) in, new arrays out."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.transforms import Floats

Indices = NDArray[np.int64]
FaceIndices = NDArray[np.integer[Any]]
Mask = NDArray[np.bool_]

#: Faces at an edge whose angles differ by less are coincident [rad].
_SAME_ANGLE = 1e-9


def merge_vertices(vertices: Floats, faces: Indices, tolerance: float) -> tuple[Floats, Indices]:
    """Merge vertices that round to the same point of a grid of `tolerance`; drop unused ones."""
    used, faces = np.unique(faces, return_inverse=True)
    vertices, faces = vertices[used], faces.reshape(-1, 3)
    cells = np.round((vertices - vertices.min(axis=0)) / tolerance).astype(np.int64)
    _, first, inverse = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    # Keep the file's order of vertices instead of the order of the sorted cells.
    order = np.argsort(first, kind="stable")
    rank = np.empty(len(first), dtype=np.int64)
    rank[order] = np.arange(len(first))
    return vertices[first[order]], rank[inverse.reshape(-1)][faces]


def face_vectors(vertices: Floats, faces: FaceIndices) -> Floats:
    """Compute the normals (F, 3) of faces; their lengths are twice the areas."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return np.cross(b - a, c - a)


def points_on_faces(corners: Floats, u: Floats, v: Floats) -> Floats:
    """Return area-uniform points (N, 3) on triangles (N, 3, 3) for numbers (N, 1) of the unit interval."""
    a, b, c = np.moveaxis(corners, 1, 0)
    root = np.sqrt(u)
    return np.asarray(a * (1 - root) + b * (root * (1 - v)) + c * (root * v))


def face_areas(vertices: Floats, faces: FaceIndices) -> Floats:
    return np.linalg.norm(face_vectors(vertices, faces), axis=1) / 2


def outward_hull(points: Floats, simplices: NDArray[Any], normals: Floats) -> tuple[Floats, NDArray[np.int32]]:
    """Return corners (H, 3) and outward triangles (G, 3) from qhull's simplices and outward normals."""
    corners, faces = drop_unused_vertices(points, simplices)
    inward = np.einsum("ij,ij->i", face_vectors(corners, faces), normals) < 0
    faces[inward] = faces[inward][:, ::-1]
    return corners, faces.astype(np.int32)


def drop_unused_vertices(vertices: Floats, faces: FaceIndices) -> tuple[Floats, Indices]:
    used, inverse = np.unique(faces, return_inverse=True)
    return vertices[used], inverse.reshape(-1, 3)


def join_meshes(parts: Sequence[tuple[Floats, FaceIndices]]) -> tuple[Floats, Indices]:
    """Join meshes, given as vertices and faces, in one mesh."""
    starts = np.cumsum([0] + [len(vertices) for vertices, _ in parts[:-1]])
    faces = [faces + start for (_, faces), start in zip(parts, starts, strict=True)]
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate(faces)


def degenerate_faces(vertices: Floats, faces: Indices) -> Mask:
    """Return a mask (F,) of faces that are thinner than 1e-6 of their longest side."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    longest = np.linalg.norm(np.stack([b - a, c - b, a - c]), axis=2).max(axis=0)
    height = np.linalg.norm(face_vectors(vertices, faces), axis=1) / np.maximum(longest, 1e-300)
    return np.asarray(height <= 1e-6 * longest)


def repeated_faces(faces: Indices) -> Mask:
    """Return a mask (F,) of faces to drop so that each set of three vertices is used at most once.
    Two coincident faces of opposite winding enclose nothing: both are dropped if the surface stays closed."""
    key = np.sort(faces, axis=1)
    _, group, size = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    group = group.reshape(-1)
    drop = np.zeros(len(faces), dtype=bool)
    if (size == 1).all():
        return drop
    # Sign of the permutation that sorts a face: +1 for one winding, -1 for the other.
    x, y, z = faces.T
    parity = np.where((x < y).astype(int) + (y < z) + (z < x) == 2, 1, -1)
    order = np.argsort(group, kind="stable")
    single = size[group] == 1
    keys, counts = np.unique(_edge_keys(faces[single]), return_counts=True)
    edges_left = {(int(key) >> 32, int(key) & 0xFFFFFFFF): int(n) for key, n in zip(keys, counts, strict=True)}
    for members in np.split(order, np.cumsum(size)[:-1]):
        if len(members) == 1:
            continue
        drop[members] = True
        corners = key[members[0]]
        others = [edges_left.get((int(corners[i]), int(corners[j])), 0) for i, j in ((0, 1), (1, 2), (0, 2))]
        balanced = parity[members].sum() == 0
        if not (balanced and all(n % 2 == 0 for n in others)):
            majority = 1 if parity[members].sum() >= 0 else -1
            drop[members[np.argmax(parity[members] == majority)]] = False
    return drop


def _edge_keys(faces: Indices, *, directed: bool = False) -> Indices:
    """Encode edges (3F,) as numbers in the order of `directed_edges`; numbers sort far faster than pairs."""
    edges = directed_edges(faces)
    edges = edges if directed else np.sort(edges, axis=1)
    return (edges[:, 0] << 32) | edges[:, 1]


def directed_edges(faces: Indices) -> Indices:
    """Return edges (3F, 2) in the direction of each face: first all 0-1 edges, then all 1-2, then all 2-0."""
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def edge_faces(faces: Indices) -> tuple[Indices, Indices]:
    """Return the undirected edge (3F,) of each directed edge, and the number of faces (E,) at each."""
    _, index, counts = np.unique(_edge_keys(faces), return_inverse=True, return_counts=True)
    return index.reshape(-1), counts


def is_closed(faces: Indices) -> bool:
    """Check whether every edge has exactly two faces that run along it in opposite directions."""
    _, counts = np.unique(_edge_keys(faces, directed=True), return_counts=True)
    _, both = np.unique(_edge_keys(faces), return_counts=True)
    return bool(len(faces) and (counts == 1).all() and (both == 2).all())


def count_open_edges(faces: Indices) -> int:
    """Return the number of edges with an odd number of faces: the rims of holes."""
    return int((edge_faces(faces)[1] % 2 == 1).sum())


def _sort_by_edge(faces: Indices) -> tuple[Indices, Indices, Indices]:
    """Return directed edges (3F,) sorted by undirected edge, and the first place and count (E,) of each."""
    index, counts = edge_faces(faces)
    return np.argsort(index, kind="stable"), np.cumsum(counts) - counts, counts


def pair_faces(faces: Indices) -> tuple[Indices, Indices, Mask]:
    """Return the two faces, (M,) and (M,), at each manifold edge, and a mask (M,) of agreeing windings."""
    order, starts, counts = _sort_by_edge(faces)
    pairs = starts[counts == 2]
    one, two = order[pairs], order[pairs + 1]
    edges = directed_edges(faces)
    agree = edges[one, 0] == edges[two, 1]
    return one % len(faces), two % len(faces), agree


def connected_parts(one: Indices, other: Indices, count: int) -> NDArray[np.int32]:
    """Number the connected parts (N,) of `count` nodes; edges join nodes `one` (E,) with `other` (E,)."""
    from scipy.sparse import coo_matrix  # slow to load, and a prepared object needs none
    from scipy.sparse.csgraph import connected_components

    graph = coo_matrix((np.ones(len(one)), (one, other)), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1])


def components(faces: Indices) -> Indices:
    """Return the index (F,) of each face's connected component (by shared vertices)."""
    label = connected_parts(faces[:, :2].T.ravel(), faces[:, 1:].T.ravel(), int(faces.max()) + 1)
    _, numbers = np.unique(label[faces[:, 0]], return_inverse=True)
    return numbers.reshape(-1).astype(np.int64)


def unify_winding(faces: Indices) -> tuple[Indices, bool]:
    """Flip faces so that neighbours agree; return whether that was possible (not on a Moebius strip).
    A graph has two nodes for each face, as it is and flipped; an edge joins nodes that agree. A component is one
    consistent choice. A face connected with its own flipped copy belongs to a non-orientable surface."""
    count = len(faces)
    one, two, agree = pair_faces(faces)
    cross = np.where(agree, 0, count)
    rows = np.concatenate([one, one + count])
    columns = np.concatenate([two + cross, two + count - cross])
    label = connected_parts(rows, columns, 2 * count)
    orientable = bool((label[:count] != label[count:]).all())
    # A patch has two choices; the one that flips fewer faces is taken, since most of a file is usually right.
    low = np.minimum(label[:count], label[count:])
    as_is = label[:count] == low
    share = np.bincount(low, as_is, minlength=2 * count) * 2 >= np.bincount(low, minlength=2 * count)
    turn = as_is != share[low]
    return np.where(turn[:, None], faces[:, ::-1], faces), orientable


def split_edges(vertices: Floats, faces: Indices) -> tuple[Floats, Indices]:
    """Split edges with more than two faces: vertices there are duplicated, one for each fan of faces.
    Faces at a crowded edge are paired as neighbours around the edge that enclose material between them."""
    order, starts, counts = _sort_by_edge(faces)
    count, edges = len(faces), directed_edges(faces)
    simple = starts[counts == 2]
    one, two = [order[simple]], [order[simple + 1]]
    for edge in np.flatnonzero(counts > 2):
        half = order[starts[edge] : starts[edge] + counts[edge]]
        pairs = np.array(_pair_half_edges(vertices, faces, edges, half), dtype=np.int64).reshape(-1, 2)
        one.append(pairs[:, 0])
        two.append(pairs[:, 1])
    a, b = np.concatenate(one), np.concatenate(two)
    # Half-edge k F + f runs from corner k of face f to corner k + 1; its partner runs in the opposite direction.
    start, end = _corner(a, count), _corner(b, count)
    after, before = _corner(a, count, 1), _corner(b, count, 1)
    rows, columns = np.concatenate([start, after]), np.concatenate([before, end])
    label = connected_parts(rows, columns, 3 * count)
    _, first, inverse = np.unique(label, return_index=True, return_inverse=True)
    return vertices[faces.reshape(-1)[first]], inverse.reshape(-1, 3).astype(np.int64)


def separate_double_edges(vertices: Floats, faces: Indices) -> tuple[Floats, Indices]:
    """Separate edges between the same two vertices: all but one edge get a vertex in the middle.
    Such edges are valid on a surface with a tunnel, but in a list of faces they look like one edge with four faces."""
    order, starts, counts = _sort_by_edge(faces)
    count, edges = len(faces), directed_edges(faces)
    points, extra, touched = [vertices], [], set[int]()
    changed = faces.copy()
    for edge in np.flatnonzero(counts > 2):
        half = order[starts[edge] : starts[edge] + counts[edge]]
        for pair in _pair_half_edges(vertices, faces, edges, half)[1:]:
            if touched & {int(h % count) for h in pair}:
                continue
            middle = len(vertices) + len(points) - 1
            points.append(vertices[edges[pair[0]]].mean(axis=0, keepdims=True))
            for h in pair:
                face, corner = int(h % count), int(h // count)
                touched.add(face)
                a, b, c = (int(faces[face, (corner + step) % 3]) for step in range(3))
                changed[face] = (a, middle, c)
                extra.append((middle, b, c))
    return np.concatenate(points), np.concatenate([changed, np.array(extra, dtype=np.int64).reshape(-1, 3)])


def _corner(half: Indices, count: int, step: int = 0) -> Indices:
    """Return the number 3 f + k of the corner at which a half-edge starts; with step 1, at which it ends."""
    return 3 * (half % count) + (half // count + step) % 3


def _pair_half_edges(vertices: Floats, faces: Indices, edges: Indices, half: Indices) -> list[tuple[int, int]]:
    """Pair half-edges at one edge: sorted by angle, each face is joined to the next face on its back side."""
    a, b = np.sort(edges[half[0]])
    axis = vertices[b] - vertices[a]
    axis /= max(float(np.linalg.norm(axis)), 1e-300)
    count = len(faces)
    apex = np.array([vertices[next(v for v in faces[h % count] if v not in (a, b))] for h in half]) - vertices[a]
    flat = apex - (apex @ axis)[:, None] * axis
    x = flat[0] / max(float(np.linalg.norm(flat[0])), 1e-300)
    angle = np.arctan2(flat @ np.cross(axis, x), flat @ x)
    # Parts that touch have coincident faces; the face with its material before it comes first.
    angle = np.round(np.where(angle <= -np.pi + _SAME_ANGLE, np.pi, angle) / _SAME_ANGLE)
    order = np.lexsort((edges[half, 0] != a, angle))
    forward = edges[half[order], 0] == a
    # The material of a face that runs a -> b is on the side of smaller angle, so it closes with the face before it.
    closing = [k for k in range(len(order)) if forward[k] and not forward[k - 1]]
    if 2 * len(closing) != len(order):
        return []
    return [(int(half[order[k]]), int(half[order[k - 1]])) for k in closing]


def from_manifold(solid: Any) -> tuple[Floats, Indices]:
    mesh = solid.to_mesh64()
    return np.array(mesh.vert_properties, dtype=np.float64)[:, :3], np.array(mesh.tri_verts, dtype=np.int64)
