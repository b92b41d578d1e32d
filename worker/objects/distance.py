"""Distance from points to a triangle mesh, and the deviation between two meshes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from worker.objects.topology import Floats, Indices

#: Candidate triangles per point: those of the nearest surface samples.
_CANDIDATES = 12


class MeshDistance:
    """Distances to one mesh. Answers are exact up to the choice of candidates, and never too small."""

    def __init__(self, vertices: Floats, faces: Indices, samples: int = 20_000) -> None:
        self._corners = vertices[faces]
        points, face = sample_faces(vertices, faces, samples)
        centres = self._corners.mean(axis=1)
        self._face = np.concatenate([np.arange(len(faces)), face])
        self._tree = cKDTree(np.concatenate([centres, points]))

    def __call__(self, points: Floats) -> Floats:
        """(N,) distance of points (N, 3) to the surface [m]."""
        k = min(_CANDIDATES, len(self._face))
        _, nearest = self._tree.query(points, k=k)
        triangles = self._corners[self._face[nearest.reshape(len(points), k)]]
        return point_triangle_distance(points[:, None], triangles).min(axis=1)


def deviation(one: tuple[Floats, Indices], two: tuple[Floats, Indices], samples: int = 8000) -> float:
    """Largest distance [m] between two surfaces, both ways, over their vertices and even samples."""
    furthest = 0.0
    for source, target in ((one, two), (two, one)):
        points = np.concatenate([source[0], sample_faces(*source, samples)[0]])
        furthest = max(furthest, float(MeshDistance(*target)(points).max()))
    return furthest


def sample_faces(vertices: Floats, faces: Indices, count: int, seed: int = 0) -> tuple[Floats, NDArray[np.int64]]:
    """Area-uniform points (count, 3) and their faces (count,), stratified; the same for the same mesh."""
    corners = vertices[faces]
    a, b, c = np.moveaxis(corners, 1, 0)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    rng = np.random.default_rng(seed)
    ladder = (np.arange(count) + rng.random(count)) / count * areas.sum()
    face = np.minimum(np.searchsorted(np.cumsum(areas), ladder, side="right"), len(faces) - 1)
    u, v = rng.random((2, count, 1))
    root = np.sqrt(u)
    points = a[face] * (1 - root) + b[face] * (root * (1 - v)) + c[face] * (root * v)
    return points, face.astype(np.int64)


def point_triangle_distance(points: Floats, triangles: Floats) -> Floats:
    """Distance of points (..., 3) to triangles (..., 3, 3); leading axes broadcast.

    The foot of the perpendicular if it falls inside, else the nearest point of the three sides.
    """
    a, b, c = triangles[..., 0, :], triangles[..., 1, :], triangles[..., 2, :]
    normal = np.cross(b - a, c - a)
    square = np.einsum("...i,...i", normal, normal)
    sides = np.minimum(np.minimum(_segment(points, a, b), _segment(points, b, c)), _segment(points, c, a))
    relative = points - a
    height = np.einsum("...i,...i", relative, normal)
    v = np.einsum("...i,...i", np.cross(relative, c - a), normal)
    w = np.einsum("...i,...i", np.cross(b - a, relative), normal)
    inside = (v >= 0) & (w >= 0) & (v + w <= square) & (square > 0)
    plane = np.abs(height) / np.sqrt(np.maximum(square, 1e-300))
    return np.where(inside, plane, sides)


def _segment(points: Floats, start: Floats, end: Floats) -> Floats:
    along = end - start
    length = np.maximum(np.einsum("...i,...i", along, along), 1e-300)
    t = np.clip(np.einsum("...i,...i", points - start, along) / length, 0, 1)
    return np.linalg.norm(points - start - t[..., None] * along, axis=-1)
