"""Inner radius and volume of convex hulls in six dimensions: three to four times as fast as qhull on wrench spaces."""

from __future__ import annotations

import threading
from typing import Any, Final

import numpy as np
import warp as wp
from numpy.typing import NDArray

from worker.simulation.kernels import hull as kernels

Floats = NDArray[np.float64]

#: Points are moved at random by this share of the largest coordinate, so that no 7 of them lie in one hyperplane. Less
#: leaves slivers whose planes are rounding errors, more is an error itself; on cubes this one is off by 4e-8 in volume.
JOGGLE: Final = 1e-8
#: Facets that may live at once: 160 random points have some 13,000.
CAPACITY: Final = 40_000
#: Entries of the hash table of ridges; one inserted point makes some thousands at most.
_TABLE: Final = 1 << 16
MAX_POINTS: Final = 512
_DIMENSION: Final = 6
#: A point that is above a plane by less than this share of the largest coordinate is on it: products of coordinates
#: round by some 1e-15, and ε is off by no more than this.
_ROUNDING: Final = 1e-13
_LAST_STAMP: Final = 2**31 - 2 * MAX_POINTS


class _Workspace(threading.local):
    """Arrays that the hulls of one thread use in turn; `views` are the same memory for NumPy."""

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
        for name in ("offset", "area", "height"):
            setattr(self.hull, name, wp.zeros(CAPACITY, **real))
        for name in ("state", "seen", "fresh", "spare"):
            setattr(self.hull, name, wp.zeros(CAPACITY, **one))
        self.hull.ridge = wp.zeros(_TABLE, dtype=wp.int64, device="cpu")
        self.hull.holder = wp.zeros(_TABLE, **one)
        self.hull.stamp = wp.zeros(_TABLE, **one)
        self.result = wp.zeros(3, **real)
        marks = np.random.default_rng(0).integers(1, 2**58, MAX_POINTS)
        self.marks = wp.array(marks, dtype=wp.int64, device="cpu")
        self.next_stamp = 1

    def stamps(self, count: int) -> int:
        """First of `count` stamps that no entry of the table has."""
        if self.next_stamp + count > _LAST_STAMP:
            self.hull.stamp.zero_()
            self.next_stamp = 1
        first = self.next_stamp
        self.next_stamp += count
        return first


_workspace = _Workspace()


def radius_and_volume(points: Floats) -> tuple[float, float] | None:
    """Distance of the nearest facet from the origin (negative: the origin is outside) and volume of a 6-D hull.

    Args:
        points: (P, 6), 8 to `MAX_POINTS` of them, not all in one hyperplane.

    Returns:
        None where the arithmetic did not give a closed hull: take another way.
    """
    points, corners = _joggled(points)
    order = np.setdiff1d(np.arange(len(points), dtype=np.int32), corners)
    with wp.ScopedDevice("cpu"):
        found = _grown(kernels.grow_hull, points, corners, wp.array(order, dtype=wp.int32))
    return found if found is not None and np.isfinite(found).all() else None


def radius(points: Floats) -> float | None:
    """The same distance alone, exact as well, in about a tenth of the time; any value up to 0 if the origin is outside.

    Args:
        points: (P, 6), 8 to `MAX_POINTS` of them, not all in one hyperplane.

    Returns:
        None where the arithmetic did not give a closed hull: take another way.
    """
    points, corners = _joggled(points)
    found = _grown(kernels.grow_to_nearest, points, corners, _ROUNDING * float(np.abs(points).max()))
    return found[0] if found is not None and np.isfinite(found[0]) else None


def _joggled(points: Floats) -> tuple[Floats, NDArray[np.int32]]:
    """The points, moved by next to nothing, and the corners of the simplex to begin with."""
    joggle = np.random.default_rng(0).uniform(-1.0, 1.0, points.shape) * JOGGLE * float(np.abs(points).max())
    moved: Floats = points + joggle
    return moved, _simplex(moved)


def _grown(kernel: Any, points: Floats, corners: NDArray[np.int32], second: Any) -> tuple[float, float] | None:
    """What a kernel finds of a hull that begins with a simplex; None if that is not sound."""
    space = _workspace
    _begin(space.hull, points, corners)
    with wp.ScopedDevice("cpu"):
        given = [wp.array(points, dtype=kernels.vec6), second, space.marks, _TABLE - 1, space.stamps(len(points))]
        wp.launch(kernel, 1, inputs=given, outputs=[space.hull, space.result], device="cpu")
    least, volume, sound = space.result.numpy()
    return (float(least), float(volume)) if sound else None


def _simplex(points: Floats) -> NDArray[np.int32]:
    """(7,) points far apart: each the farthest from the flat through those before it."""
    first = int(np.argmax(((points - points.mean(axis=0)) ** 2).sum(axis=1)))
    chosen, rest = [first], points - points[first]
    for _ in range(_DIMENSION):
        far = int(np.argmax((rest**2).sum(axis=1)))
        chosen.append(far)
        axis = rest[far] / np.linalg.norm(rest[far])
        rest = rest - np.outer(rest @ axis, axis)
    return np.array(chosen, np.int32)


def _begin(hull: Any, points: Floats, corners: NDArray[np.int32]) -> None:
    """Write the facets of the first simplex: facet i leaves out corner i, and lies across it from all others."""
    views = {name: getattr(hull, name).numpy() for name in ("vertex", "neighbour", "normal", "offset", "area", "state")}
    middle = points[corners].mean(axis=0)
    for i in range(_DIMENSION + 1):
        others = [j for j in range(_DIMENSION + 1) if j != i]
        corner = points[corners[others]]
        edges = corner[1:] - corner[0]
        normal = np.linalg.svd(edges)[2][-1]
        if normal @ middle > normal @ corner[0]:
            normal = -normal
        views["vertex"][i], views["neighbour"][i] = corners[others], others
        views["normal"][i], views["offset"][i] = normal, normal @ corner[0]
        views["area"][i] = np.sqrt(abs(np.linalg.det(edges @ edges.T))) / 120.0
    views["state"][:] = 0
    views["state"][: _DIMENSION + 1] = 1
