"""The contact step in float64 NumPy, written for clarity: the reference of the kernels and of studies.

A motion (6,) is a translation, then a rotation vector. Distances and free motions may have leading axes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graspd.service.model.transforms import Floats

SMOOTH = 1e-5


@dataclass(frozen=True)
class Contacts:
    points: Floats  # (N, 3) [m]
    normals: Floats  # (N, 3)
    distances: Floats  # (..., N) [m]
    weights: Floats  # (N,)


@dataclass(frozen=True)
class World:
    inertia: Floats
    gyration: float
    friction: float = 0.8
    stiffness: float = 1.0
    step: float = 1e-3
    dilation: float = 0.0

    @property
    def mass(self) -> Floats:
        m = np.eye(6)
        m[3:, 3:] = self.inertia
        return m


def jacobian_row(normal: Floats, point: Floats) -> Floats:
    """Return rows (..., 6) that map a motion to the displacement of `point` along `normal`, both (..., 3)."""
    return np.concatenate([normal, np.cross(point, normal)], axis=-1)


def loss(s: Floats, world: World) -> Floats:
    """Return the loss (...) of motions (..., 6)."""
    lengths = [np.sqrt(np.sum(v * v, axis=-1) + SMOOTH**2) for v in (s[..., :3], world.gyration * s[..., 3:])]
    return np.asarray((lengths[0] + lengths[1]) / world.step)


def direct(contacts: Contacts, s0: Floats, world: World, passes: int = 60) -> Floats:
    """Return motions (..., 6) in compliant contact for free motions (..., 6), by reweighted least squares."""
    n, offset = contacts.normals, world.dilation - contacts.distances
    k = world.stiffness * contacts.weights
    j = jacobian_row(n, contacts.points)
    across = np.eye(3) - n[:, :, None] * n[:, None, :]
    jt = jacobian_row(across, contacts.points[:, None, :])
    pushes, slides = j[:, :, None] * j[:, None, :], np.einsum("nei,nej->nij", jt, jt)
    s = s0
    for _ in range(passes):
        c = offset + s @ j.T
        tangent = np.einsum("nei,...i->...ne", jt, s)
        slip = np.maximum(np.linalg.norm(tangent, axis=-1), 1e-9)
        push = np.where(c > 0, k, 0.0)
        slide = np.where(c > 0, np.minimum(k, k * world.friction * c / slip), 0.0)
        a = world.mass + np.tensordot(push, pushes, 1) + np.tensordot(slide, slides, 1)
        s = np.linalg.solve(a, (s0 @ world.mass - (push * offset) @ j)[..., None])[..., 0]
    return np.asarray(s)


def gauss_seidel(contacts: Contacts, s0: Floats, world: World) -> tuple[Floats, Floats]:
    """Return motions (..., 6), and impulses (..., N, 2), normal and tangential, after one sweep."""
    s = s0
    impulses = []
    for i, (p, n) in enumerate(zip(contacts.points, contacts.normals, strict=True)):
        impulse, change = _push_out(p, n, contacts.distances[..., i], s, world)
        s = s + change
        slip, change = _apply_friction(p, n, impulse, s, world)
        s = s + change
        impulses.append(np.stack([impulse, slip], axis=-1))
    return s, np.stack(impulses, axis=-2)


def jacobi(contacts: Contacts, s0: Floats, world: World, passes: int) -> Floats:
    """Return motions (..., 6) after `passes` steps, each with the mean correction of all active contacts."""
    p, n = contacts.points, contacts.normals
    s = s0
    for _ in range(passes):
        impulse, push = _push_out(p, n, contacts.distances, s[..., None, :], world)
        _, slide = _apply_friction(p, n, impulse, s[..., None, :], world)
        active = np.sum(impulse > 0, axis=-1, keepdims=True)
        s = s + (push + slide).sum(axis=-2) / np.maximum(active, 1)
    return s


def _push_out(p: Floats, n: Floats, rho: Floats, s: Floats, world: World) -> tuple[Floats, Floats]:
    """Return normal impulses (...) that end penetration at points (..., 3), and the motions they cause."""
    j = jacobian_row(n, p)
    back = j @ np.linalg.inv(world.mass)
    impulse = np.maximum(world.dilation - rho + np.sum(j * s, axis=-1), 0.0) / np.sum(j * back, axis=-1)
    return impulse, -impulse[..., None] * back


def _apply_friction(p: Floats, n: Floats, impulse: Floats, s: Floats, world: World) -> tuple[Floats, Floats]:
    """Return tangential impulses (...) within the friction cone, and the motion they cause (..., 6)."""
    u = s[..., :3] + np.cross(s[..., 3:], p)
    tangent = u - np.sum(n * u, axis=-1, keepdims=True) * n
    length = np.linalg.norm(tangent, axis=-1)
    jt = jacobian_row(tangent / np.maximum(length, 1e-9)[..., None], p)
    back = jt @ np.linalg.inv(world.mass)
    weight = np.sum(jt * back, axis=-1)
    slip = np.where(length > 1e-9, np.minimum(length / np.maximum(weight, 1e-9), world.friction * impulse), 0.0)
    return slip, -slip[..., None] * back
