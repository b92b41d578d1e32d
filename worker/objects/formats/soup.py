"""Triangles of a file, checked for data that later steps cannot handle; polygons are triangulated."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, TypeVar

import manifold3d
import numpy as np
from numpy.typing import NDArray

from graspd.service.model.contact_region import is_part_name
from graspd.service.model.errors import LimitError, MeshError
from graspd.service.model.transforms import Floats
from graspd.worker.objects.topology import face_vectors, from_manifold, join_meshes

MAX_FACES: Final = 1_000_000
#: Largest plausible coordinate in any unit.
MAX_COORDINATE: Final = 1e11


@dataclass(frozen=True)
class Soup:
    """Vertices (V, 3) in the file's unit and triangles (F, 3) as indices, with unknown topology."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    colours: NDArray[np.float64] | None = None
    """(F, 3) sRGB colour of each face, 0 .. 1, NaN if not stated; None if no face has one."""
    paint: NDArray[np.float64] | None = None
    """(F, 3) colours that select faces but are not drawn; None: those of `colours`."""
    names: FaceNames | None = None
    matter: Mapping[str, float] = field(default_factory=dict)
    """What the file states of `mass` [kg], `density` [kg/m^3] and `friction`."""
    inertial: tuple[Floats, Floats] | None = None
    """Centre of mass (3,) and inertia (3, 3) about it per unit of mass, in the file's unit; None if not stated."""
    is_rigid: bool = False  # the file states that its parts are one rigid body

    def by_colour(self) -> list[tuple[tuple[float, float, float] | None, NDArray[np.intp]]]:
        """Return each colour with the indices of its faces; faces without a colour are under None."""
        if self.colours is None:
            return [(None, np.arange(len(self.faces)))]
        # NaN is not equal to itself; no colour is below 0.
        known, index = np.unique(np.nan_to_num(np.round(self.colours, 3), nan=-1.0), axis=0, return_inverse=True)
        return [
            (None if rgb[0] < 0 else (float(rgb[0]), float(rgb[1]), float(rgb[2])), np.flatnonzero(index == i))
            for i, rgb in enumerate(known)
        ]


#: Largest number of sets of names in a mesh; faces of further sets have no name.
MAX_PARTS: Final = 1000


@dataclass(frozen=True)
class FaceNames:
    """Names of the parts of a mesh to which each face belongs."""

    sets: tuple[tuple[str, ...], ...]
    index: NDArray[np.int64]  # (F,) set of each face

    @classmethod
    def of(cls, runs: Iterable[tuple[int, Iterable[str]]]) -> FaceNames:
        """Return the names of faces from runs: a number of faces, and their names."""
        rows: dict[tuple[str, ...], int] = {(): 0}
        counts, index = list[int](), list[int]()
        for count, names in runs:
            key = tuple(dict.fromkeys(filter(is_part_name, names)))
            if len(rows) < MAX_PARTS:
                rows.setdefault(key, len(rows))
            counts.append(count)
            index.append(rows.get(key, 0))
        return cls(tuple(rows), np.repeat(np.array(index, np.int64), counts))


_MAX_DEPTH: Final = 32
_MAX_NODES: Final = 10_000
Node = TypeVar("Node")
#: Vertices (V, 3), triangles (F, 3), 4x4 matrix of the part's place, sRGB colour (3,), NaN if not stated, and names.
Part = tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64], NDArray[np.float64], tuple[str, ...]]


def walk_scene(
    roots: Iterable[Node], matrix_of: Callable[[Node], Floats], below: Callable[[Node], Iterable[Node]]
) -> Iterator[tuple[Node, Floats]]:
    """Yield each node of a scene with its 4x4 matrix; a node that is named twice appears twice."""
    stack = [(node, np.eye(4), 0) for node in roots]
    visited = 0
    while stack:
        node, parent, depth = stack.pop()
        visited += 1
        if depth > _MAX_DEPTH or visited > _MAX_NODES:
            raise MeshError("the node tree is too deep, too large or cyclic; flatten the scene")
        matrix = parent @ matrix_of(node)
        yield node, matrix
        stack += [(child, matrix, depth + 1) for child in below(node)]


def join_parts(parts: Iterable[Part]) -> Soup:
    """Join the placed parts of a scene; mirrored ones are turned outward."""
    meshes: list[tuple[Floats, NDArray[np.int64]]] = []
    colours: list[Floats] = []
    names = list[tuple[int, tuple[str, ...]]]()
    count = total = 0
    for points, triangles, matrix, colour, named in parts:
        flipped = triangles[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else triangles
        meshes.append((points @ matrix[:3, :3].T + matrix[:3, 3], flipped))
        colours.append(np.tile(colour, (len(triangles), 1)))
        names.append((len(triangles), named))
        count, total = count + len(points), total + len(triangles)
        check_face_count(max(total, count // 3))
    if not meshes:
        raise MeshError("the mesh has no faces; export a scene with a mesh")
    known = np.concatenate(colours)
    return Soup(*join_meshes(meshes), None if np.isnan(known).all() else known, names=FaceNames.of(names))


def check_soup(soup: Soup) -> Soup:
    """Return the soup itself if it has faces, valid indices and finite vertices."""
    vertices, faces = soup.vertices, soup.faces
    if not len(faces):
        raise MeshError("the mesh has no faces; export the surface, not points alone")
    check_face_count(len(faces))
    bad = (faces < 0) | (faces >= len(vertices))
    if bad.any():
        row = int(np.flatnonzero(bad.any(axis=1))[0])
        raise MeshError(f"face {row} has an index outside the {len(vertices)} vertices; export the mesh again")
    used = vertices[np.unique(faces)]
    if not np.isfinite(used).all():
        raise MeshError("a vertex is not finite (NaN or infinity); repair the mesh where it was made")
    if np.abs(used).max() > MAX_COORDINATE:
        raise MeshError(f"a coordinate exceeds {MAX_COORDINATE:g}; the file is damaged or in no known unit")
    return soup


def check_face_count(count: int) -> None:
    if count > MAX_FACES:
        raise LimitError(f"{count} faces; at most {MAX_FACES} are taken: decimate the mesh first")


Ints = NDArray[np.int64]

#: Limit on the sum of squared corner counts of re-entrant polygons; triangulation needs up to 2 ns per unit.
MAX_SQUARES: Final = 10**9
#: Least ratio of areas, triangle to polygon, at which a triangle of opposite winding counts.
_AGAINST: Final = 1e-9


def triangulate(vertices: Floats, counts: Ints, corners: Ints) -> Ints:
    """Triangulate polygons with `counts` corners each, concatenated in `corners`; return triangles (F, 3).
    A polygon is cut as a fan from its first corner, or by ear clipping if the fan would leave it. Faces with fewer than
    three corners are dropped. Raises LimitError: too many faces, or re-entrant polygons of too many corners."""
    number = np.maximum(counts - 2, 0)
    check_face_count(int(number.sum()))
    starts, ends = np.cumsum(counts) - counts, np.cumsum(number)
    start = np.repeat(starts, number)
    step = np.arange(len(start)) - np.repeat(ends - number, number)
    triangles = np.stack([corners[start], corners[start + step + 1], corners[start + step + 2]], axis=1)
    if not (number > 1).any() or (triangles < 0).any() or (triangles >= len(vertices)).any():
        return triangles
    normals = face_vectors(vertices, triangles)
    owner = np.repeat(np.arange(len(counts)), number)
    # The sum over a fan is the polygon's vector area for any position of its corners.
    whole = np.stack([np.bincount(owner, normals[:, k], len(counts)) for k in range(3)], axis=1)
    against = np.einsum("ij,ij->i", normals, whole[owner]) < -_AGAINST * np.einsum("ij,ij->i", whole, whole)[owner]
    wrong = np.unique(owner[against])
    if (counts[wrong].astype(float) ** 2).sum() > MAX_SQUARES:
        raise LimitError("its re-entrant polygons have too many corners; triangulate the mesh where it was made")
    for one in wrong:
        ring = corners[starts[one] : starts[one] + counts[one]]
        inside = manifold3d.triangulate([_project_to_plane(vertices[ring], whole[one])])
        # Clipping of a self-intersecting polygon may return fewer triangles; such a polygon stays a fan.
        if len(inside) == number[one]:
            triangles[ends[one] - number[one] : ends[one]] = ring[inside]
    return triangles


def _project_to_plane(points: Floats, normal: Floats) -> Floats:
    """Project points to (n, 2) as seen against `normal`, counter-clockwise."""
    axis = normal / np.linalg.norm(normal)
    across = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    across /= np.linalg.norm(across)
    return np.stack([points @ across, points @ np.cross(axis, across)], axis=1)


#: Segments of a circle in round primitives: chords stay within 0.13 % of the radius.
_SEGMENTS: Final = 64


def primitive(kind: str, sizes: Sequence[float]) -> tuple[Floats, Ints]:
    """Return vertices and faces of a box (x, y, z), sphere (r), or cylinder, capsule or cone (r, length).
    The length is along z, that of a capsule without its caps. Raises MeshError: a size is not positive."""
    if not all(0 < size < math.inf for size in sizes):
        raise MeshError(f"a {kind} of size {sizes}; sizes are positive")
    if kind == "box":
        return from_manifold(manifold3d.Manifold.cube(sizes, True))
    if kind in ("cylinder", "cone"):
        end = sizes[0] if kind == "cylinder" else 0.0
        return from_manifold(manifold3d.Manifold.cylinder(sizes[1], sizes[0], end, _SEGMENTS, True))
    ball = manifold3d.Manifold.sphere(sizes[0], _SEGMENTS)
    if kind == "sphere":
        return from_manifold(ball)
    ends = [ball.translate((0, 0, side * sizes[1] / 2)) for side in (-1, 1)]
    return from_manifold(manifold3d.Manifold.batch_hull(ends))
