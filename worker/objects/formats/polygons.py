"""Polygons cut into triangles: n corners become n - 2 triangles, inside the polygon where it has re-entrant corners."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from service.model.errors import LimitError
from worker.objects.formats.soup import check_face_count

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

#: Ear clipping takes time with the square of the corners: all squares of a file's re-entrant polygons together.
MAX_SQUARES: Final = 2 * 10**7
#: A triangle against the polygon's winding counts from this share of the polygon's area on.
_AGAINST: Final = 1e-9


def triangulate(vertices: Floats, counts: Ints, corners: Ints) -> Ints:
    """Triangles (F, 3) of polygons with `counts` corners each, laid out one after another in `corners`.

    A polygon is cut as a fan from its first corner, or by ear clipping where the fan would leave it. Faces with fewer
    than three corners are dropped.

    Raises:
        LimitError: too many faces, or re-entrant polygons of too many corners.
    """
    number = np.maximum(counts - 2, 0)
    check_face_count(int(number.sum()))
    starts, ends = np.cumsum(counts) - counts, np.cumsum(number)
    start = np.repeat(starts, number)
    step = np.arange(len(start)) - np.repeat(ends - number, number)
    triangles = np.stack([corners[start], corners[start + step + 1], corners[start + step + 2]], axis=1)
    if not (number > 1).any() or (triangles < 0).any() or (triangles >= len(vertices)).any():
        return triangles
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    normals = np.cross(b - a, c - a)
    owner = np.repeat(np.arange(len(counts)), number)
    # The sum over a fan is the polygon's vector area, whatever its corners do.
    whole = np.stack([np.bincount(owner, normals[:, k], len(counts)) for k in range(3)], axis=1)
    against = np.einsum("ij,ij->i", normals, whole[owner]) < -_AGAINST * np.einsum("ij,ij->i", whole, whole)[owner]
    wrong = np.unique(owner[against])
    if (counts[wrong].astype(float) ** 2).sum() > MAX_SQUARES:
        raise LimitError("its re-entrant polygons have too many corners; triangulate the mesh where it was made")
    for one in wrong:
        ring = corners[starts[one] : starts[one] + counts[one]]
        triangles[ends[one] - number[one] : ends[one]] = ring[_clip(_flat(vertices[ring], whole[one]))]
    return triangles


def _flat(points: Floats, normal: Floats) -> Floats:
    """(n, 2) points as seen against `normal`, counter-clockwise."""
    axis = normal / np.linalg.norm(normal)
    across = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    across /= np.linalg.norm(across)
    return np.stack([points @ across, points @ np.cross(axis, across)], axis=1)


def _clip(points: Floats) -> Ints:
    """(n - 2, 3) corners of the ears of a counter-clockwise polygon (n, 2); corners on a line are kept."""
    left, found = list(range(len(points))), []
    while len(left) > 3:
        at = _ear(points[left])
        found.append((left[at - 1], left[at], left[(at + 1) % len(left)]))
        del left[at]
    return np.array([*found, left], dtype=np.int64)


def _ear(ring: Floats) -> int:
    """Corner whose triangle holds no other corner: of those the one with the widest least angle."""
    before, after = np.roll(ring, 1, axis=0), np.roll(ring, -1, axis=0)
    area = _cross(ring - before, after - ring)
    longest = np.maximum(
        np.linalg.norm(ring - before, axis=1),
        np.maximum(np.linalg.norm(after - ring, axis=1), np.linalg.norm(after - before, axis=1)),
    )
    shape = area / np.maximum(longest, 1e-300) ** 2
    inward = np.flatnonzero(area <= 0)
    for at in np.argsort(-shape, kind="stable"):
        if area[at] <= 0:
            break
        a, b, c = before[at], ring[at], after[at]
        others = ring[inward]
        corner = (others == a).all(axis=1) | (others == b).all(axis=1) | (others == c).all(axis=1)
        inside = (_cross(b - a, others - a) >= 0) & (_cross(c - b, others - b) >= 0) & (_cross(a - c, others - c) >= 0)
        if not (inside & ~corner).any():
            return int(at)
    # Only corners on a line, or a polygon that crosses itself, have no ear: the flattest corner changes least.
    return int(np.argmin(np.abs(shape)))


def _cross(u: Floats, v: Floats) -> Floats:
    return np.asarray(u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0])
