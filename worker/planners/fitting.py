"""Check before planning whether an object fits between the jaws of a gripper.

Two opposite fingers can hold an object at two surface points with opposite normals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.errors import InputError
from graspd.service.model.transforms import Floats
from graspd.worker.hands.jaws import jaws_of
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.memory_cache import cached_by_content
from graspd.worker.objects.mesh_geometry import points_on_triangles
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.region import ContactRegion

#: Number of surface samples of a region; largest number on the whole object, and fewest in a region.
SAMPLES: Final = 500
DENSEST: Final = 50_000
FEWEST: Final = 20
#: Clearance between the opening and the object on each side [m].
FIT_M: Final = 0.001


def fitting_pairs(hand: HandModel, obj: ObjectModel) -> Pairs | None:
    """Return pairs of opposite points that fit between the jaws of a hand; None if the hand is no gripper.
    Raises InputError: no pair fits; the message states the opening."""
    jaws = jaws_of(hand)
    if jaws is None:
        return None
    pairs = antipodal_pairs(obj)
    fits = pairs.width <= jaws.opening - 2 * FIT_M
    if fits.any():
        return Pairs(pairs.start[fits], pairs.end[fits])
    if not len(pairs.start):
        raise InputError(f"{obj.name} has no two opposite sides that a gripper such as {hand.name} could hold")
    raise InputError(
        f"{hand.name} opens {1e3 * jaws.opening:.0f} mm; the narrowest side of {obj.name} is "
        f"{1e3 * float(pairs.width.min()):.0f} mm: choose a smaller object (--scale-to) or a hand that opens wider"
    )


#: Number of surface points from which rays are cast; standard deviation of the rays' tilt from the normal [rad].
_POINTS: Final = 768
_TILT: Final = 0.08
#: Least cosine of the angle between a ray and the surface normal at its exit: 20 degrees.
_OPPOSITE_COS: Final = 0.94
#: Least thickness that can be held [m].
_THINNEST_M: Final = 5e-4
_CHUNK: Final = 64


@dataclass(frozen=True)
class Pairs:
    """P pairs of points (P, 3), object frame [m].
    The space between two points may be hollow: fingers grasp from outside."""

    start: Floats
    end: Floats

    @property
    def width(self) -> Floats:
        """(P,) distance of the points [m]."""
        return np.asarray(np.linalg.norm(self.end - self.start, axis=1))


@cached_by_content(16)
def antipodal_pairs(obj: ObjectModel) -> Pairs:
    """Pair evenly spread surface points with each point where a ray cast inwards leaves the solid."""
    rng = np.random.default_rng(0xA47)
    corners, normal, _ = surface_of(obj)
    start, face = even_points(obj, _POINTS, rng)
    way = -normal[face] + _TILT * rng.standard_normal((_POINTS, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    starts, ends = [], []
    for first in range(0, _POINTS, _CHUNK):
        rows = slice(first, first + _CHUNK)
        ray, length = _exits(start[rows], way[rows], corners, normal)
        starts.append(start[rows][ray])
        ends.append(start[rows][ray] + length[:, None] * way[rows][ray])
    return Pairs(np.concatenate(starts), np.concatenate(ends))


def surface_of(obj: ObjectModel) -> tuple[Floats, Floats, Floats]:
    """Return the faces' corners (F, 3, 3), unit normals (F, 3) and cumulative share of the area (F,)."""
    corners = obj.vertices[obj.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1)
    return corners, cross / np.maximum(area, 1e-20)[:, None], np.cumsum(area) / area.sum()


def even_points(obj: ObjectModel, count: int, rng: np.random.Generator) -> tuple[Floats, NDArray[np.intp]]:
    """Return points (count, 3) spread evenly over the area of the surface, and their faces (count,)."""
    corners, _, sums = surface_of(obj)
    face = np.searchsorted(sums, (np.arange(count) + rng.random(count)) / count)
    face = np.minimum(face, len(sums) - 1)
    u, v = rng.random((2, count, 1))
    return points_on_triangles(corners[face], u, v), face


def region_points(obj: ObjectModel, region: ContactRegion) -> tuple[Floats, NDArray[np.intp]]:
    """Return about `SAMPLES` points (P, 3), spread evenly over a region, and their faces (P,).
    Raises InputError: the region has hardly any surface."""
    count = SAMPLES
    while True:
        place, face = even_points(obj, count, np.random.default_rng(0))
        inside = np.flatnonzero(region.contains(place))
        if len(inside) >= SAMPLES or region.is_whole or (count == DENSEST and len(inside) > FEWEST):
            return place[inside], face[inside]
        if count == DENSEST:
            raise InputError(
                f"{obj.name} has no surface in the region that grasps may touch: check the bounds, which are in metres "
                "in the object's frame"
            )
        count = min(DENSEST, int(1.2 * count * SAMPLES / max(len(inside), 20)))


def _exits(start: Floats, way: Floats, corners: Floats, normal: Floats) -> tuple[NDArray[np.intp], Floats]:
    """Intersect rays from `start` (n, 3) with F triangles; return ray index and distance [m] of exits.
    A ray exits through a face whose normal points along the ray (Moeller and Trumbore 1997)."""
    edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    p = np.cross(way[:, None], edge2[None])
    determinant = np.einsum("nfj,fj->nf", p, edge1)
    safe = np.where(np.abs(determinant) < 1e-18, np.inf, determinant)
    to = start[:, None] - corners[None, :, 0]
    u = np.einsum("nfj,nfj->nf", p, to) / safe
    q = np.cross(to, edge1[None])
    v = np.einsum("nj,nfj->nf", way, q) / safe
    length = np.einsum("nfj,fj->nf", q, edge2) / safe
    inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (length > _THINNEST_M) & (way @ normal.T > _OPPOSITE_COS)
    ray, face = np.nonzero(inside)
    return ray, length[ray, face]
