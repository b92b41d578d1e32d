"""Grasp wrench space by the conventions of GraspIt! (Miller & Allen 2004): epsilon (Ferrari & Canny 1992) and volume.

Each contact's friction cone is a pyramid of 8 edges with unit normal component, f = n + mu (cos a t1 + sin a t2); its
torque about the centre of mass is divided by the object's largest radius. The L1 space is the convex hull of all edges
(normal forces sum to at most 1), the L-infinity space the Minkowski sum of the contacts' pyramids with their apex
(each at most 1).

Epsilon is the radius of the largest ball around the origin inside the space, hence 0 where the origin is not inside
(GraspIt! reports -1 there); flat spaces have epsilon 0 and volume 0.
"""

from __future__ import annotations

from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from service.model.errors import InputError
from service.model.transforms import Floats, cross
from worker.quality.hull import MAX_POINTS, measure_hulls

Norm = Literal["l1", "linf"]

EDGES: Final = 8
#: Least over largest singular value below which a set of wrenches is flat.
FLATNESS: Final = 1e-7
#: Most contacts of an L-infinity space: its points grow ninefold with each.
MAX_LINF_CONTACTS: Final = 4
#: From this number of points on our own hull is the faster one.
MANY: Final = 24


def tangents(normals: Floats) -> tuple[Floats, Floats]:
    """Two unit tangents (..., 3) each, t1 x t2 = n; along the coordinate axes where the normal is."""
    n = np.asarray(normals, float)
    axis = np.eye(3)[np.argmin(np.abs(n), axis=-1)]
    t1 = cross(n, axis)
    t1 /= np.linalg.norm(t1, axis=-1, keepdims=True)
    return t1, cross(n, t1)


def cone_edges(
    normals: Floats, friction: float, *, edges: int = EDGES, unit: Literal["normal", "force"] = "normal"
) -> Floats:
    """(..., E, 3) edge forces of the friction pyramids about inward unit normals (..., 3).

    `unit` says what has length 1: the normal component (GraspIt!) or the force itself (FRoGGeR).
    """
    t1, t2 = tangents(normals)
    angle = 2 * np.pi * np.arange(edges) / edges
    around = np.cos(angle)[:, None] * t1[..., None, :] + np.sin(angle)[:, None] * t2[..., None, :]
    force: Floats = np.asarray(normals, float)[..., None, :] + friction * around
    return force / np.sqrt(1 + friction**2) if unit == "force" else force


def wrenches(
    points: Floats,
    normals: Floats,
    *,
    friction: float,
    centre: Floats,
    radius: float,
    edges: int = EDGES,
) -> Floats:
    """(..., E, 6) edge wrenches: force, then torque about `centre` over `radius`.

    Args:
        points: (..., 3) contact points [m].
        normals: (..., 3) unit normals into the object.
        friction: Coulomb coefficient.
        centre: (3,) torque origin, the centre of mass [m].
        radius: torque scale, the object's largest radius [m].
        edges: edges of the pyramid.
    """
    force = cone_edges(normals, friction, edges=edges)
    torque = cross((np.asarray(points, float) - centre)[..., None, :] / radius, force)
    return np.concatenate([force, torque], axis=-1)


def measure_space(edge_wrenches: Floats, *, norm: Norm = "l1") -> tuple[float, float]:
    """Epsilon and volume of the wrench space of N contacts.

    Args:
        edge_wrenches: (N, E, D) edge wrenches of each contact; D is 6, or fewer for a subspace.
        norm: l1 or linf.

    Raises:
        InputError: linf with more than `MAX_LINF_CONTACTS` contacts.
    """
    (epsilon,), (volume,) = measure_spaces(
        edge_wrenches[None], np.array([len(edge_wrenches)]), np.ones(1, bool), norm=norm
    )
    return float(epsilon), float(volume)


def measure_spaces(
    edge_wrenches: Floats, contacts: NDArray[np.integer], with_volume: NDArray[np.bool_], *, norm: Norm = "l1"
) -> tuple[Floats, Floats]:
    """Epsilon and volume of many wrench spaces.

    Args:
        edge_wrenches: (S, N, E, D) edge wrenches; of each space the first `contacts` contacts are its own.
        contacts: (S,).
        with_volume: (S,) whether the volume is wanted: epsilon alone is as exact, in a tenth of the time.
        norm: l1 or linf.

    Returns:
        (S,) epsilon; (S,) volume, nan where it is not wanted.

    Raises:
        InputError: linf with more than `MAX_LINF_CONTACTS` contacts.
    """
    epsilon, volume = np.full((2, len(edge_wrenches)), np.nan)
    none = np.asarray(contacts) == 0
    epsilon[none], volume[none] = 0.0, 0.0
    if norm == "l1" and edge_wrenches.shape[-1] == 6:
        clouds = edge_wrenches.reshape(len(edge_wrenches), -1, 6)
        count = np.asarray(contacts) * edge_wrenches.shape[2]
        ours = np.flatnonzero((count >= MANY) & (count <= MAX_POINTS))
        most = int(count[ours].max(initial=0))
        epsilon[ours], volume[ours] = measure_hulls(clouds[ours, :most], count[ours], np.asarray(with_volume)[ours])
    for row in np.flatnonzero(np.isnan(epsilon)):
        epsilon[row], volume[row] = _measure_by_qhull(edge_wrenches[row, : contacts[row]], norm)
    return np.maximum(epsilon, 0.0), np.where(with_volume | none, volume, np.nan)


def _measure_by_qhull(edge_wrenches: Floats, norm: Norm) -> tuple[float, float]:
    """Epsilon and volume of contacts that our own hull does not take: few, flat ones, or too many."""
    hull = _hull(_points(edge_wrenches, norm))
    if hull is None:
        return 0.0, 0.0
    return float(-hull.equations[:, -1].max()), float(hull.volume)


def _points(edge_wrenches: Floats, norm: Norm) -> Floats:
    return edge_wrenches.reshape(-1, edge_wrenches.shape[-1]) if norm == "l1" else _minkowski(edge_wrenches)


def _hull(points: Floats) -> Any:
    from scipy.spatial import ConvexHull, QhullError

    if len(points) <= points.shape[1] or _flat(points):
        return None
    # Joggled input is fastest and simplicial; exact merging is for what defeats it.
    for options in ("QJ", "Qt Qx"):
        try:
            return ConvexHull(points, qhull_options=options)
        except QhullError:
            continue
    return None


def _flat(points: Floats) -> bool:
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[-1] <= FLATNESS * max(spread[0], 1e-300))


def _minkowski(edge_wrenches: Floats) -> Floats:
    """Points whose hull is the Minkowski sum of the contacts' pyramids, each with its apex at the origin."""
    contacts, _, dimension = edge_wrenches.shape
    if contacts > MAX_LINF_CONTACTS:
        raise InputError(
            f"the L-infinity wrench space of {contacts} contacts is too large: take at most {MAX_LINF_CONTACTS}, or L1"
        )
    total = np.zeros((1, dimension))
    for edges in edge_wrenches:
        # Only corners of the sum so far can become corners of the whole.
        hull = _hull(total)
        total = total if hull is None else total[hull.vertices]
        pyramid = np.vstack([np.zeros((1, dimension)), edges])
        total = (total[:, None] + pyramid[None]).reshape(-1, dimension)
    return total
