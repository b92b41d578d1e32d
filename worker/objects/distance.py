"""Distance from points to a triangle mesh, and the deviation between two meshes."""

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.transforms import Floats
from graspd.worker.objects.topology import Indices, face_vectors, points_on_faces

#: Least number of pieces of a mesh, so that pieces are small relative to the mesh.
_PIECES = 10_000
#: Number of nearest pieces checked first, quadrupled until the result is proven.
_CANDIDATES = 12
_CHUNK = 256
_MAX_VERTICES = 30_000


class MeshDistance:
    """Exact distances to one mesh.
    The triangles are cut into pieces no longer than a fixed length. The best triangle of the nearest pieces gives a
    distance. This distance is exact if the next piece's centre is farther away by more than a piece's radius."""

    def __init__(self, vertices: Floats, faces: Indices) -> None:
        from scipy.spatial import cKDTree

        self._corners = vertices[faces]
        centres, self._radius, self._face = subdivide_triangles(self._corners, 2, _PIECES)
        self._tree = cKDTree(centres)

    def __call__(self, points: Floats, enough: float = 0.0) -> Floats:
        """Return distances (N,) of points (N, 3) to the surface [m]; those below `enough` are upper bounds."""
        found = np.full(len(points), np.inf)
        todo, k = np.arange(len(points)), min(_CANDIDATES, len(self._face))
        while len(todo):
            reach, nearest = (np.asarray(part) for part in self._tree.query(points[todo], k=np.arange(1, k + 1)))
            triangles = self._corners[self._face[nearest]]
            found[todo] = point_triangle_distance(points[todo][:, None], triangles).min(axis=1)
            open_ = (reach[:, -1] < found[todo] + self._radius) & (found[todo] > enough)
            if k == len(self._face):
                break
            todo, k = todo[open_], min(4 * k, len(self._face))
        return found

    def largest(self, points: Floats) -> float:
        """Return the largest distance of any of the points (N, 3) to the surface [m].
        Exact distances are computed only for points whose first upper bound exceeds the largest exact distance."""
        bounds = self(points, np.inf)
        order = np.argsort(-bounds)
        proven = 0.0
        for start in range(0, len(points), _CHUNK):
            chunk = order[start : start + _CHUNK]
            if bounds[chunk[0]] <= proven:
                break
            proven = max(proven, float(self(points[chunk]).max()))
        return proven


def subdivide_triangles(corners: Floats, factor: float, count: int) -> tuple[Floats, float, NDArray[np.int64]]:
    """Halve triangles (F, 3, 3) until no side exceeds `factor` * sqrt(total area / `count`).
    Return the centres (P, 3) of the pieces, their largest radius, and the triangle (P,) of each."""
    a, b, c = np.moveaxis(corners, 1, 0)
    area = float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)
    length = factor * np.sqrt(area / count)
    done, owners = list[Floats](), list[NDArray[np.int64]]()
    face = np.arange(len(corners), dtype=np.int64)
    while len(corners):
        sides = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
        longest = sides.argmax(axis=1)
        small = sides.max(axis=1) <= length
        done.append(corners[small])
        owners.append(face[small])
        turned = np.take_along_axis(corners, ((longest[:, None] + np.arange(3)) % 3)[:, :, None], axis=1)[~small]
        a, b, c = np.moveaxis(turned, 1, 0)
        middle = (a + b) / 2
        corners = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
        face = np.tile(face[~small], 2)
    pieces = np.concatenate(done)
    centres = pieces.mean(axis=1)
    return centres, float(np.linalg.norm(pieces - centres[:, None], axis=2).max()), np.concatenate(owners)


def deviation(one: tuple[Floats, Indices], two: tuple[Floats, Indices], samples: int = 8000) -> float:
    """Compute the largest distance [m] of two surfaces, both ways, over vertices and even samples."""
    pairs = ((one, two), (two, one))
    return max(MeshDistance(*target).largest(surface_points(*source, samples)) for source, target in pairs)


def surface_points(vertices: Floats, faces: Indices, samples: int) -> Floats:
    """Return points to compare surfaces: vertices (every n-th if there are very many) and even samples."""
    step = max(1, len(vertices) // _MAX_VERTICES)
    return np.concatenate([vertices[::step], sample_faces(vertices, faces, samples)[0]])


def sample_faces(vertices: Floats, faces: Indices, count: int, seed: int = 0) -> tuple[Floats, NDArray[np.int64]]:
    """Sample area-uniform points (count, 3) and their faces (count,), stratified and reproducible."""
    areas = np.linalg.norm(face_vectors(vertices, faces), axis=1)
    rng = np.random.default_rng(seed)
    ladder = (np.arange(count) + rng.random(count)) / count * areas.sum()
    face = np.minimum(np.searchsorted(np.cumsum(areas), ladder, side="right"), len(faces) - 1)
    return points_on_faces(vertices[faces[face]], *rng.random((2, count, 1))), face.astype(np.int64)


def point_triangle_distance(points: Floats, triangles: Floats) -> Floats:
    """Compute the distance of points (..., 3) to triangles (..., 3, 3); leading axes broadcast.
    The nearest point is the foot of the perpendicular if it is inside the triangle, else a point of the three sides."""
    a, b, c = triangles[..., 0, :], triangles[..., 1, :], triangles[..., 2, :]
    normal = np.cross(b - a, c - a)
    square = np.einsum("...i,...i", normal, normal)
    sides = np.minimum(
        np.minimum(_segment_distance(points, a, b), _segment_distance(points, b, c)), _segment_distance(points, c, a)
    )
    relative = points - a
    height = np.einsum("...i,...i", relative, normal)
    v = np.einsum("...i,...i", np.cross(relative, c - a), normal)
    w = np.einsum("...i,...i", np.cross(b - a, relative), normal)
    inside = (v >= 0) & (w >= 0) & (v + w <= square) & (square > 0)
    plane = np.abs(height) / np.sqrt(np.maximum(square, 1e-300))
    return np.where(inside, plane, sides)


def _segment_distance(points: Floats, start: Floats, end: Floats) -> Floats:
    along = end - start
    length = np.maximum(np.einsum("...i,...i", along, along), 1e-300)
    t = np.clip(np.einsum("...i,...i", points - start, along) / length, 0, 1)
    return np.linalg.norm(points - start - t[..., None] * along, axis=-1)
