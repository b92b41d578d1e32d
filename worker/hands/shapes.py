"""Collision shapes of a robot as convex pieces.
Primitives stay exact. A mesh becomes one hull, or several hulls if its surface lies deep inside one hull.

The error of a mesh's pieces is the depth of the mesh surface beneath them, along the shortest free direction outward.
The ninth decile over the visible outer surface counts."""

import hashlib
from collections.abc import Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.digests import digest_json
from graspd.service.model.errors import HandError, MeshError
from graspd.service.model.libraries import version_of
from graspd.service.model.transforms import IDENTITY_POSE, Floats, apply, quat_to_matrix
from graspd.service.store.mesh_files import find_mesh
from graspd.worker.hands.model import ConvexPiece
from graspd.worker.hands.primitives import compute_hull, hull, hull_planes, signed_distance, tessellate, volume
from graspd.worker.hands.robot import Ints, Shape
from graspd.worker.hands.visuals import merge_and_thin
from graspd.worker.objects.convex import WorkLimitExceeded, coacd_parts, default_cache, load_parts, save_parts
from graspd.worker.objects.disk_cache import cached_step
from graspd.worker.objects.formats import read_mesh
from graspd.worker.objects.topology import face_areas, points_on_faces

#: A hull of V corners has at most 2 V - 4 triangles: 96 here. Every plane costs time in each distance query.
MAX_HULL_VERTICES: Final = 50
#: A longer mesh [m] probably has millimetres without a scale.
MAX_PIECE_M: Final = 2.0

Hulls = dict[tuple[str, tuple[float, ...]], list[tuple[Floats, Ints]]]


def make_pieces(
    shape: Shape, *, body: int, pose: Floats, link: str, files: Mapping[str, bytes], base: str, hulls: Hulls
) -> list[ConvexPiece]:
    """Make the convex pieces of a shape at `pose` (7,) in the body frame; several for a mesh with hollows.
    `hulls` are those of this hand's meshes so far, by name and scale: fingers often share a fingertip mesh.
    Raises HandError: a mesh is missing, outside the upload, unreadable, flat or far too large."""
    if shape.kind != "mesh":
        vertices, faces = tessellate(shape.kind, shape.size)
        return [ConvexPiece(body, shape.kind, shape.size, pose, apply(pose, vertices), faces, link)]
    name = ""
    try:
        if shape.mesh is not None:
            found = _reduced_hulls(*shape.mesh)
        else:
            name = find_mesh(shape.filename, files, base, link)
            key = (name, shape.size)
            if key not in hulls:
                try:
                    soup = read_mesh(name, files[name])
                except MeshError as error:
                    raise HandError(f"collision mesh of link {link!r}: {error}") from None
                points = soup.vertices * np.asarray(shape.size)
                if np.ptp(points, axis=0).max() > MAX_PIECE_M:
                    raise HandError(
                        f"collision mesh {name!r} of link {link!r} is {np.ptp(points, axis=0).max():.3g} m long; "
                        'if it is in millimetres give it scale="0.001 0.001 0.001"'
                    )
                hulls[key] = _reduced_hulls(points, soup.faces.astype(np.int32))
            found = hulls[key]
    except HandError as error:
        if repr(link) in str(error):
            raise
        raise HandError(f"collision mesh {f'{name!r} ' if name else ''}of link {link!r}: {error}") from None
    return [
        ConvexPiece(body, "hull", (), IDENTITY_POSE.copy(), apply(pose, vertices), faces, link)
        for vertices, faces in found
    ]


def _reduced_hulls(points: Floats, faces: Ints) -> list[tuple[Floats, Ints]]:
    # Hulls use all points of a file, including points that no face uses: `convex_parts` returns them for one hull.
    return [reduce_hull(part) for part in convex_parts(points, faces)]


def reduce_hull(points: Floats) -> tuple[Floats, Ints]:
    """Compute a hull of points (N, 3) with at most `MAX_HULL_VERTICES` corners and the full hull's volume.
    The corner farthest from the current hull is added repeatedly; then all are scaled about their centroid until the
    volumes agree. The surface error has both signs and half the size of an inscribed hull's error."""
    made = cached_step("reduced hull", [points, np.array(MAX_HULL_VERTICES)], lambda: _compute_reduced_hull(points))
    return made["0"], made["1"]


def _compute_reduced_hull(points: Floats) -> tuple[Floats, Ints]:
    vertices, faces = compute_hull(points)
    if len(vertices) <= MAX_HULL_VERTICES:
        return vertices, faces
    full = volume("hull", (), vertices, faces)
    directions = np.concatenate([np.eye(3), -np.eye(3)])
    chosen = list(dict.fromkeys(np.argmax(vertices @ directions.T, axis=0).tolist()))
    while len(chosen) < MAX_HULL_VERTICES:
        farthest = int(np.argmax(_excess_distance(vertices, vertices[chosen])))
        if farthest in chosen:
            break
        chosen.append(farthest)
    corners, faces = compute_hull(vertices[chosen])
    centre = corners.mean(axis=0)
    growth = (full / volume("hull", (), corners, faces)) ** (1 / 3)
    return centre + (corners - centre) * growth, faces


def _excess_distance(points: Floats, corners: Floats) -> Floats:
    """Return the distance (N,) of points (N, 3) from a small hull; from its nearest corner if it is flat."""
    spread = np.linalg.svd(corners - corners.mean(axis=0), compute_uv=False)
    if len(corners) < 4 or spread[2] < 1e-6 * spread[0]:
        return np.linalg.norm(points[:, None] - corners[None], axis=2).min(axis=1)
    return signed_distance("hull", (), *compute_hull(corners), points)


#: Error of a hull above which the mesh is decomposed [m]: an object would rest this far off the finger.
MAX_ERROR_M: Final = 4e-3
#: Largest number of pieces of a link: each costs time in every distance query.
MAX_PIECES: Final = 8
_THRESHOLDS: Final = (0.1, 0.05)
_COACD: Final = {
    "preprocess_mode": "auto",
    "preprocess_resolution": 40,
    "resolution": 800,
    "mcts_iterations": 20,
    "mcts_nodes": 10,
    "max_convex_hull": MAX_PIECES,
    "seed": 1,
}
#: Number of faces to which a mesh is simplified before its decomposition.
_FACES: Final = 1200
#: CPU time limit of a CoACD run [s]: twice the time of the slowest mesh of 1,200 faces.
_CPU_S: Final = 120
#: Number of points that measure a mesh's error, and their share with a smaller error than the reported one.
_POINTS: Final = 200
_SHARE: Final = 0.9
#: Largest depth beneath the hull at which a surface is not hollow [m].
_FLAT_M: Final = 5e-4
#: The six axes and the eight diagonals, slightly rotated, since meshes have many faces along the axes.
_TURN: Final = quat_to_matrix(np.array([0.9974, 0.0312, 0.0417, 0.0503]))
_WAYS: Final = np.array([d for d in np.ndindex(3, 3, 3) if sum(k != 1 for k in d) in (1, 3)]) - 1.0
_DIRECTIONS: Final = (_WAYS / np.linalg.norm(_WAYS, axis=1, keepdims=True)) @ _TURN.T
#: Offset of a ray's origin from its point [m].
_START_M: Final = 1e-5
#: Thickness below which pieces are splinters [m].
_MIN_EXTENT_M: Final = 1e-3


def convex_parts(vertices: Floats, faces: Ints) -> tuple[Floats, ...]:
    """Return corners of the convex pieces of a mesh, or all its corners if its hull is accurate.
    Raises HandError: the decomposition exceeds its CPU time limit."""
    if _is_convex(vertices, faces):
        return (vertices,)
    shape = hashlib.sha256(np.ascontiguousarray(vertices).tobytes() + np.ascontiguousarray(faces).tobytes())
    settings = [_COACD, list(_THRESHOLDS), MAX_ERROR_M, _POINTS, _FACES, version_of("coacd")]
    file = default_cache() / f"hand-{digest_json({'shape': shape.hexdigest(), 'settings': settings})}.npz"
    if file.is_file() and (kept := load_parts(file)):
        return kept if len(kept) > 1 else (vertices,)
    best, sure = _decompose(vertices, faces)
    if sure:
        save_parts(file, best if len(best) > 1 else (np.zeros((1, 3)),))
    return best if len(best) > 1 else (vertices,)


def _decompose(vertices: Floats, faces: Ints) -> tuple[tuple[Floats, ...], bool]:
    """Return the pieces, and whether CoACD finished; a failed run may succeed later."""
    light = merge_and_thin(vertices, faces, lambda count: 1 - _FACES / count)
    surface = _OpenSurface(*light)
    best: tuple[Floats, ...] = (vertices,)
    least, sure = surface.error(best), True
    for threshold in _THRESHOLDS:
        if least <= MAX_ERROR_M:
            break
        try:
            made = coacd_parts(*light, {"threshold": threshold, **_COACD}, _CPU_S)
        except WorkLimitExceeded as limit:
            # A slow machine must not give a hand other shapes than a fast one.
            raise HandError(f"its convex decomposition needs {limit}; simplify it") from None
        sure &= bool(made)
        parts = tuple(part for part in made if len(part) > 3 and np.ptp(part, axis=0).min() > _MIN_EXTENT_M)
        if parts and (error := surface.error(parts)) < least:
            best, least = parts, error
        if len(made) >= MAX_PIECES:
            # With a finer threshold CoACD needs twice the time for the same number of pieces.
            break
    return best, sure


def _is_convex(vertices: Floats, faces: Ints) -> bool:
    """Check whether nearly all of the surface lies on the hull, so that no decomposition is needed."""
    normals, offsets = hull_planes(*hull(vertices[np.unique(faces)]))
    depth = (offsets - _sample_surface(vertices, faces) @ normals.T).min(axis=1)
    return float(np.quantile(depth, _SHARE)) < _FLAT_M


def _sample_surface(vertices: Floats, faces: Ints) -> Floats:
    areas = face_areas(vertices, faces)
    ladder = (np.arange(_POINTS) + 0.5) / _POINTS * areas.sum()
    face = np.minimum(np.searchsorted(np.cumsum(areas), ladder), len(faces) - 1)
    return points_on_faces(vertices[faces[face]], *np.random.default_rng(0).random((2, _POINTS, 1)))


class _OpenSurface:
    """Points on a mesh with the directions in which each is visible from outside."""

    def __init__(self, vertices: Floats, faces: Ints) -> None:
        corners, self._points = vertices[faces], _sample_surface(vertices, faces)
        # (D, P) whether a ray in a direction from a point misses the mesh.
        self._sees = np.array([~_hit_mask(self._points, direction, corners) for direction in _DIRECTIONS])

    def error(self, parts: tuple[Floats, ...]) -> float:
        """Return the ninth decile of the open surface's depth in the union of the parts [m]."""
        reached = self._sees.any(axis=0)
        if not reached.any():
            return 0.0
        way = np.zeros((len(_DIRECTIONS), len(self._points)))
        for part in parts:
            np.maximum(way, _exit_distances(part, self._points), out=way)
        shortest = np.where(self._sees, way, np.inf).min(axis=0)
        return float(np.quantile(shortest[reached], _SHARE))


def _hit_mask(points: Floats, direction: Floats, corners: Floats) -> NDArray[np.bool_]:
    """Return a mask (P,) of the rays that hit any triangle (F, 3, 3) (Moeller and Trumbore 1997)."""
    a, first, second = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    across = np.cross(direction, second)
    determinant = np.einsum("ij,ij->i", first, across)
    usable = np.abs(determinant) > 1e-14
    a, first, second, across = a[usable], first[usable], second[usable], across[usable]
    inverse = 1 / determinant[usable]
    hit = np.zeros(len(points), dtype=bool)
    for number, point in enumerate(points):
        offset = point - a
        u = np.einsum("kf,kf->k", offset, across) * inverse
        beside = np.cross(offset, first)
        v = beside @ direction * inverse
        t = np.einsum("kf,kf->k", beside, second) * inverse
        hit[number] = ((u >= 0) & (v >= 0) & (u + v <= 1) & (t > _START_M)).any()
    return hit


def _exit_distances(part: Floats, points: Floats) -> Floats:
    """Return the distance (D, P) at which rays from points leave a part's hull; 0 for points outside."""
    normals, offsets = hull_planes(*hull(part))
    inside = offsets - points @ normals.T
    rates = _DIRECTIONS @ normals.T
    way = np.full((len(_DIRECTIONS), len(points)), np.inf)
    for number, rate in enumerate(rates):
        onward = rate > 1e-9
        way[number] = (inside[:, onward] / rate[onward]).min(axis=1)
    return np.where((inside < -_START_M).any(axis=1), 0.0, np.maximum(way, 0.0))
