"""Convex solids: tessellation, area, surface samples, signed distance, features (balls, rims, edges).

All functions work in the solid's own frame; cylinders and capsules have their axis along z and are centred."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.errors import HandError
from graspd.service.model.transforms import Floats, quat_rotate
from graspd.worker.hands.robot import Ints
from graspd.worker.objects.disk_cache import cached_step
from graspd.worker.objects.topology import directed_edges, face_areas, face_vectors, outward_hull, points_on_faces

if TYPE_CHECKING:
    from graspd.worker.hands.model import ConvexPiece

#: Corners of a circle in tessellations: the chord stays within 0.5 % of the radius.
SEGMENTS = 32


def hull(points: Floats) -> tuple[Floats, Ints]:
    """Compute corners (V, 3) and outward triangles (F, 3) of a hull of points (N, 3); HandError if flat."""
    made = cached_step("hull", [points], lambda: compute_hull(points))
    return made["0"], made["1"]


def compute_hull(points: Floats) -> tuple[Floats, Ints]:
    from scipy.spatial import ConvexHull, QhullError  # slow to load

    scale = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
    if len(points) < 4 or scale <= 0:
        raise HandError("a collision shape has no volume; give it at least four points that are not in one plane")
    try:
        qhull = ConvexHull((points - points.mean(axis=0)) / scale)
    except QhullError:
        raise HandError("a collision shape is flat; give it a thickness") from None
    return outward_hull(points, qhull.simplices, qhull.equations[:, :3])


def tessellate(kind: str, size: tuple[float, ...]) -> tuple[Floats, Ints]:
    """Return corners and outward triangles of a primitive; corners of round kinds lie on the true surface."""
    if kind == "box":
        corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
        return hull(corners * np.asarray(size))
    radius = size[0]
    angle = np.arange(SEGMENTS) * (2 * math.pi / SEGMENTS)
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(SEGMENTS)], axis=1)
    if kind == "cylinder":
        return hull(np.concatenate([ring * radius + [0, 0, z] for z in (-size[1] / 2, size[1] / 2)]))
    half = size[1] / 2 if kind == "capsule" else 0.0
    latitude = np.linspace(0, math.pi / 2, SEGMENTS // 4 + 1)[:-1]
    cap = np.concatenate([ring * math.cos(t) + [0, 0, math.sin(t)] for t in latitude] + [np.array([[0.0, 0, 1]])])
    top = cap * radius + [0, 0, half]
    return hull(np.concatenate([top, top * [1, 1, -1]]))


def area(kind: str, size: tuple[float, ...], vertices: Floats, faces: Ints) -> float:
    """Compute the surface area [m^2]: in closed form for primitives, as a sum of triangles for hulls."""
    match kind:
        case "box":
            x, y, z = size
            return 2 * (x * y + y * z + z * x)
        case "sphere":
            return 4 * math.pi * size[0] ** 2
        case "cylinder":
            return 2 * math.pi * size[0] * (size[0] + size[1])
        case "capsule":
            return 2 * math.pi * size[0] * (2 * size[0] + size[1])
        case _:
            return float(face_areas(vertices, faces).sum())


def volume(kind: str, size: tuple[float, ...], vertices: Floats, faces: Ints) -> float:
    """Compute the volume [m^3]: in closed form for primitives, as a sum of tetrahedra for hulls."""
    match kind:
        case "box":
            return float(np.prod(size))
        case "sphere":
            return 4 / 3 * math.pi * size[0] ** 3
        case "cylinder":
            return math.pi * size[0] ** 2 * size[1]
        case "capsule":
            return math.pi * size[0] ** 2 * (4 / 3 * size[0] + size[1])
        case _:
            a, b, c = np.moveaxis(vertices[faces] - vertices[0], 1, 0)
            return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def sample(
    kind: str, size: tuple[float, ...], vertices: Floats, faces: Ints, count: int, rng: np.random.Generator
) -> tuple[Floats, Floats]:
    """Sample area-uniform points (count, 3) on the surface with outward normals (count, 3)."""
    if kind in ("sphere", "cylinder", "capsule"):
        return _sample_round(kind, size, count, rng)
    areas = face_areas(vertices, faces)
    # Stratified over the faces: each face gets its share of the number, rounded up or down.
    ladder = (np.arange(count) + rng.random()) / max(count, 1) * areas.sum()
    face = np.minimum(np.searchsorted(np.cumsum(areas), ladder, side="right"), len(faces) - 1)
    points = points_on_faces(vertices[faces[face]], *rng.random((2, count, 1)))
    normals = face_vectors(vertices, faces[face])
    return points, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def _sample_round(kind: str, size: tuple[float, ...], count: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
    radius, length = size[0], size[1] if len(size) > 1 else 0.0
    angle = rng.random(count) * 2 * math.pi
    around = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
    up = np.array([0.0, 0, 1])
    if kind == "cylinder":
        side = 2 * math.pi * radius * length
        on_side = np.sort(rng.random(count)) < side / (side + 2 * math.pi * radius**2)
        end = np.where(rng.random((count, 1)) < 0.5, -1.0, 1.0)
        wall = around * radius + up * ((rng.random((count, 1)) - 0.5) * length)
        cap = around * (radius * np.sqrt(rng.random((count, 1)))) + up * (end * length / 2)
        return np.where(on_side[:, None], wall, cap), np.where(on_side[:, None], around, up * end)
    # By Archimedes a sphere's area is uniform in height, and so is the area of a cylinder of the same radius.
    height = (rng.random(count) - 0.5) * (2 * radius + length)
    offset = np.clip(height, -length / 2, length / 2)
    z = np.clip((height - offset) / radius, -1, 1)
    normal = around * np.sqrt(1 - z**2)[:, None] + up * z[:, None]
    return normal * radius + up * offset[:, None], normal


def signed_distance(kind: str, size: tuple[float, ...], vertices: Floats, faces: Ints, points: Floats) -> Floats:
    """Compute the distance (N,) of points (N, 3), negative inside.
    Outside boxes, cylinders and hulls it is a lower bound with the right sign; elsewhere it is exact."""
    match kind:
        case "box":
            return (np.abs(points) - np.asarray(size) / 2).max(axis=1)
        case "sphere":
            return np.linalg.norm(points, axis=1) - size[0]
        case "cylinder":
            radial = np.linalg.norm(points[:, :2], axis=1) - size[0]
            return np.maximum(radial, np.abs(points[:, 2]) - size[1] / 2)
        case "capsule":
            axis = np.clip(points[:, 2], -size[1] / 2, size[1] / 2)
            return np.linalg.norm(points - np.stack([axis * 0, axis * 0, axis], axis=1), axis=1) - size[0]
        case _:
            normals, offsets = hull_planes(vertices, faces)
            return (points @ normals.T - offsets).max(axis=1)


def hull_planes(vertices: Floats, faces: Ints) -> tuple[Floats, Floats]:
    """Return outward unit normals (P, 3) and offsets (P,) of the faces of a hull."""
    normals = face_vectors(vertices, faces)
    lengths = np.linalg.norm(normals, axis=1)
    # A sliver of the triangulation has no defined normal.
    keep = lengths > 1e-9 * lengths.max()
    normals = normals[keep] / lengths[keep, None]
    return normals, np.einsum("ij,ij->i", normals, vertices[faces[keep, 0]])


#: Least cosine between the normals of two triangles that count as one flat face: 0.1 degrees.
COPLANAR: Final = 1 - 1.5e-6


@dataclass(frozen=True)
class HandFeatures:
    """F balls and rims, and E edges, of P convex pieces; fixed to the bodies of a hand.
    A plane meets balls and rims first; a convex solid that penetrates a piece meets one of them or an edge."""

    body: NDArray[np.int32]  # (F,)
    centre: Floats  # (F, 3) body frame
    axis: Floats  # (F, 3) axis of a rim, body frame; zero for a ball
    radius: Floats  # (F,) [m]
    first: NDArray[np.int32]  # (P + 1,) the first feature of each piece
    edges: Floats  # (E, 2, 3) ends, body frame
    thickness: Floats  # (E,) radius about an edge: 0 except for capsules and spheres
    first_edge: NDArray[np.int32]  # (P + 1,) the first edge of each piece

    def __len__(self) -> int:
        return len(self.body)

    @classmethod
    def from_pieces(cls, pieces: tuple[ConvexPiece, ...]) -> HandFeatures:
        """Collect spheres, corners and edges of boxes and hulls, ends and axes of capsules, and rims."""
        rows: list[tuple[int, Floats, Floats, float]] = []
        edges: list[Floats] = [np.zeros((0, 2, 3))]
        thickness: list[float] = []
        first, first_edge = [0], [0]
        ball = np.zeros(3)
        for piece in pieces:
            middle, axis = piece.pose[:3], quat_rotate(piece.pose[3:], np.array([0.0, 0.0, 1.0]))
            rim, radius = piece.kind == "cylinder", 0.0 if piece.kind in ("box", "hull") else piece.size[0]
            if piece.kind == "sphere":
                points, ends = middle[None], np.array([[middle, middle]])
            elif radius:
                half = 0.5 * piece.size[1] * axis
                points = np.array([middle - half, middle + half])
                ends = points[None]
            else:
                points = piece.vertices
                ends = points[convex_edges(points, piece.faces)]
            rows += [(piece.body, point, axis if rim else ball, radius) for point in points]
            edges.append(ends)
            thickness += [0.0 if rim else radius] * len(ends)
            first.append(len(rows))
            first_edge.append(len(thickness))
        return cls(
            np.array([r[0] for r in rows], np.int32),
            np.array([r[1] for r in rows]).reshape(-1, 3),
            np.array([r[2] for r in rows]).reshape(-1, 3),
            np.array([r[3] for r in rows]),
            np.array(first, np.int32),
            np.concatenate(edges),
            np.array(thickness),
            np.array(first_edge, np.int32),
        )


def convex_edges(vertices: Floats, faces: NDArray[np.integer[Any]]) -> NDArray[np.intp]:
    """Return edges (E, 2) at which a convex solid of outward triangles bends, not those within faces."""
    normal = face_vectors(vertices, faces)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    sides = np.sort(directed_edges(faces.astype(np.int64)), axis=1)
    order = np.lexsort(sides.T)
    one, other = order[0::2], order[1::2]
    if len(one) != len(other) or (sides[one] != sides[other]).any():
        return np.unique(sides, axis=0)  # an open solid may have more edges than needed
    count = len(faces)
    bends = (normal[one % count] * normal[other % count]).sum(axis=1) < COPLANAR
    return np.asarray(sides[one[bends]], np.intp)
