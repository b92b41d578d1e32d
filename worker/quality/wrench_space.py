"""Grasp wrench space by the conventions of GraspIt! (Miller & Allen 2004): epsilon and volume.

Epsilon follows Ferrari & Canny 1992. Each contact's friction cone is a pyramid of 8 edges with unit normal component: f
= n + mu (cos a t1 + sin a t2). The torque of an edge about the centre of mass is divided by the object's largest
radius. The space is the convex hull of all edges: normal forces sum to at most 1 (L1).

Epsilon is the radius of the largest ball around the origin inside the space. It is 0 where the origin is not inside
(GraspIt!: -1). Flat spaces have epsilon 0 and volume 0."""

import threading
from typing import Any, Final

import numpy as np
import warp as wp
from numpy.typing import NDArray

from graspd.service.model.transforms import Floats, Mask, cross
from graspd.worker.simulation.kernels import hull as kernels
from graspd.worker.simulation.launches import launch

Ints = NDArray[np.intp]

EDGES: Final = 8
FLATNESS: Final = 1e-7  # ratio of least to largest singular value below which a set of wrenches is flat
MANY: Final = 24  # number of points from which this module's hull is faster than Qhull


def tangents(normals: Floats) -> tuple[Floats, Floats]:
    """Return two unit tangents (..., 3), t1 x t2 = n; they are along coordinate axes if the normal is."""
    n = np.asarray(normals, float)
    axis = np.eye(3)[np.argmin(np.abs(n), axis=-1)]
    t1 = cross(n, axis)
    t1 /= np.linalg.norm(t1, axis=-1, keepdims=True)
    return t1, cross(n, t1)


def cone_edges(normals: Floats, friction: float, *, edges: int = EDGES) -> Floats:
    """Return edge forces (..., E, 3) of the friction pyramids about inward unit normals (..., 3).
    Their normal components are 1, as in GraspIt!."""
    t1, t2 = tangents(normals)
    angle = 2 * np.pi * np.arange(edges) / edges
    around = np.cos(angle)[:, None] * t1[..., None, :] + np.sin(angle)[:, None] * t2[..., None, :]
    return np.asarray(np.asarray(normals, float)[..., None, :] + friction * around)


def contact_wrenches(
    points: Floats, normals: Floats, *, friction: float, centre: Floats, radius: float, edges: int = EDGES
) -> Floats:
    """Return edge wrenches (..., E, 6): force, then torque about `centre` divided by `radius` [m].
    Contacts are at `points` (..., 3) [m] with unit normals (..., 3) into the object."""
    force = cone_edges(normals, friction, edges=edges)
    torque = cross((np.asarray(points, float) - centre)[..., None, :] / radius, force)
    return np.concatenate([force, torque], axis=-1)


def measure_spaces(edge_wrenches: Floats, contacts: NDArray[np.integer], with_volume: Mask) -> tuple[Floats, Floats]:
    """Compute epsilon and volume (S,) of many wrench spaces of edge wrenches (S, N, E, D).
    Each space uses its first `contacts` (S,) contacts. The volume is nan where `with_volume` (S,) is false: epsilon
    alone is as accurate, in a tenth of the time."""
    epsilon, volume = np.full((2, len(edge_wrenches)), np.nan)
    none = np.asarray(contacts) == 0
    epsilon[none], volume[none] = 0.0, 0.0
    if edge_wrenches.shape[-1] == 6:
        clouds = edge_wrenches.reshape(len(edge_wrenches), -1, 6)
        count = np.asarray(contacts) * edge_wrenches.shape[2]
        ours = np.flatnonzero((count >= MANY) & (count <= MAX_POINTS))
        most = int(count[ours].max(initial=0))
        epsilon[ours], volume[ours] = measure_hulls(clouds[ours, :most], count[ours], np.asarray(with_volume)[ours])
    for row in np.flatnonzero(np.isnan(epsilon)):
        epsilon[row], volume[row] = _measure_by_qhull(edge_wrenches[row, : contacts[row]])
    return np.maximum(epsilon, 0.0), np.where(with_volume | none, volume, np.nan)


def _measure_by_qhull(edge_wrenches: Floats) -> tuple[float, float]:
    """Compute epsilon and volume by Qhull where `measure_hulls` cannot: few, flat, or too many contacts."""
    from scipy.spatial import ConvexHull, QhullError

    points = edge_wrenches.reshape(-1, edge_wrenches.shape[-1])
    if len(points) <= points.shape[1] or _is_flat(points):
        return 0.0, 0.0
    # Joggled input is fastest and gives simplices; exact merging is the fallback.
    for options in ("QJ", "Qt Qx"):
        try:
            hull = ConvexHull(points, qhull_options=options)
        except QhullError:
            continue
        return float(-hull.equations[:, -1].max()), float(hull.volume)
    return 0.0, 0.0


def _is_flat(points: Floats) -> bool:
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[-1] <= FLATNESS * max(spread[0], 1e-300))


#: Random shift of the points, as a share of the largest coordinate, so that no 7 of them lie in one hyperplane. Smaller
#: shifts leave slivers with planes dominated by rounding; larger ones distort. On cubes the volume is off by 4e-8.
JOGGLE: Final = 1e-8
CAPACITY: Final = 40_000  # largest number of simultaneous facets: 160 random points have some 13,000
_TABLE: Final = 1 << 16  # entries of the hash table of ridges; inserting one point creates some thousands at most
MAX_POINTS: Final = 512
_DIMENSION: Final = 6
#: A point above a plane by less than this share of the largest coordinate counts as on it. Products of coordinates have
#: rounding errors of some 1e-15; the error of ε is not larger than this share.
_ROUNDING: Final = 1e-13
_FLAT: Final = 1e-6  # ratio of least to greatest distance in the initial simplex below which points count as flat
_LAST_STAMP: Final = 2**31 - 2 * MAX_POINTS


class _Workspace(threading.local):
    """Arrays that are reused by all hulls of one thread."""

    _lock = threading.Lock()

    def __init__(self) -> None:
        with self._lock:
            wp.load_module(module=kernels, device="cpu")
        one = {"dtype": wp.int32, "device": "cpu"}
        real = {"dtype": wp.float64, "device": "cpu"}
        self.hull: Any = kernels.Hull()
        self.hull.vertex = wp.zeros((CAPACITY, _DIMENSION), **one)
        self.hull.neighbour = wp.zeros((CAPACITY, _DIMENSION), **one)
        self.hull.normal = wp.zeros(CAPACITY, dtype=kernels.vec6, device="cpu")
        for name in ("offset", "height", "distance"):
            setattr(self.hull, name, wp.zeros(CAPACITY, **real))
        for name in ("state", "seen", "fresh", "side", "spare"):
            setattr(self.hull, name, wp.zeros(CAPACITY, **one))
        self.hull.ridge = wp.zeros(_TABLE, dtype=wp.int64, device="cpu")
        self.hull.holder = wp.zeros(_TABLE, **one)
        self.hull.stamp = wp.zeros(_TABLE, **one)
        marks = np.random.default_rng(0).integers(1, 2**58, MAX_POINTS)
        self.marks = wp.array(marks, dtype=wp.int64, device="cpu")
        self.next_stamp = 1

    def reserve_stamps(self, count: int) -> int:
        """Return the first of `count` stamps that no entry of the table uses."""
        if self.next_stamp + count > _LAST_STAMP:
            self.hull.stamp.zero_()
            self.next_stamp = 1
        first = self.next_stamp
        self.next_stamp += count
        return first


_workspace = _Workspace()


def measure_hulls(clouds: Floats, count: NDArray[np.integer], whole: Mask) -> tuple[Floats, Floats]:
    """Compute inner radius and volume (H,) of many hulls, in one launch; nan where a hull fails.
    Each hull uses the first `count` (H,) of its points `clouds` (H, P, 6), P at most `MAX_POINTS`. The radius is the
    distance from the origin to the nearest facet, at most 0 for an outside origin. Where `whole` (H,) is false, only
    the part nearest to the origin is built: a tenth of the time, equally exact, without a volume."""
    radius, volume = np.full((2, len(clouds)), np.nan)
    some = np.flatnonzero(np.asarray(count) > _DIMENSION)
    if not len(some):
        return radius, volume
    number = np.asarray(count)[some]
    own = np.arange(clouds.shape[1]) < number[:, None]
    points = np.where(own[..., None], clouds[some], 0.0)
    scale = np.abs(points).max(axis=(1, 2))
    joggle = np.random.default_rng(0).uniform(-1.0, 1.0, points.shape[1:]) * JOGGLE
    points = np.where(own[..., None], points + joggle * scale[:, None, None], 0.0)
    rows = np.arange(len(points))
    mean = points.sum(axis=1) / number[:, None]
    far = np.where(own, ((points - mean[:, None]) ** 2).sum(axis=2), -1.0)
    chosen = [np.argmax(far, axis=1)]
    rest = np.where(own[..., None], points - points[rows, chosen[0]][:, None], 0.0)
    lengths = []
    for _ in range(_DIMENSION):
        square = np.einsum("hpi,hpi->hp", rest, rest)
        farthest = np.argmax(square, axis=1)
        length = np.sqrt(square[rows, farthest])
        axis = rest[rows, farthest] / np.maximum(length, 1e-300)[:, None]
        rest = rest - np.einsum("hpi,hi->hp", rest, axis)[..., None] * axis[:, None]
        chosen.append(farthest)
        lengths.append(length)
    corners, flat = np.stack(chosen, axis=1), np.min(lengths, axis=0) <= _FLAT * np.max(lengths, axis=0)
    firm = np.flatnonzero(~flat)
    if len(firm):
        found = _grow_hulls(points[firm], number[firm], np.asarray(whole)[some][firm], corners[firm], scale[firm])
        radius[some[firm]], volume[some[firm]] = found
    return radius, volume


def _grow_hulls(
    points: Floats, count: NDArray[Any], whole: Mask, corners: Ints, scale: Floats
) -> tuple[Floats, Floats]:
    """Grow hulls from simplices (H, 7); return radius and volume (H,), nan where a hull fails."""
    corner = np.take_along_axis(points, corners[..., None], axis=1)
    middle = corner.mean(axis=1)
    normal, offset = _planes(corner - middle[:, None])
    space = _workspace
    with wp.ScopedDevice("cpu"):
        result = wp.zeros((len(points), 3), dtype=wp.float64)
        launch(
            kernels.measure_hulls,
            1,
            inputs=[
                wp.array(points - middle[:, None], dtype=kernels.vec6),
                wp.array(count, dtype=wp.int32),
                wp.array(whole, dtype=wp.int32),
                wp.array(corners, dtype=wp.int32),
                wp.array(normal, dtype=kernels.vec6),
                wp.array(offset, dtype=wp.float64),
                wp.array(-middle, dtype=kernels.vec6),
                wp.array(_ROUNDING * scale, dtype=wp.float64),
                space.marks,
                space.reserve_stamps(len(points) * points.shape[1]),
            ],
            outputs=[space.hull, result],
            device="cpu",
        )
        found = result.numpy().copy()
    found[found[:, 2] == 0] = np.nan
    return found[:, 0], found[:, 1]


def _planes(corner: Floats) -> tuple[Floats, Floats]:
    """Return planes (H, 7, 6), (H, 7) of the facets of simplices (H, 7, 6) about the origin.
    Facet i omits corner i. n x - d is minus 6! times the volume of the simplex of x and the facet. 6! times this volume
    is the barycentric coordinate of corner i times the determinant of the edges."""
    edges = corner[:, 1:] - corner[:, :1]
    size = np.abs(np.linalg.det(edges))[:, None, None]
    slope = np.swapaxes(np.linalg.inv(edges), 1, 2)
    normal = np.concatenate([slope.sum(axis=1, keepdims=True), -slope], axis=1) * size
    # Facet 0 contains corner 1, every other facet corner 0.
    on = corner[:, [1, 0, 0, 0, 0, 0, 0]]
    return normal, np.einsum("hfi,hfi->hf", normal, on)
