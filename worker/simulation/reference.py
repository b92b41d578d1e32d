"""The contact step in float64 NumPy, written for clarity: the oracle of the kernels, and of studies of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
SMOOTH = 1e-5


@dataclass(frozen=True)
class Contacts:
    points: Floats
    normals: Floats
    distances: Floats
    weights: Floats


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


def row(normal: Floats, point: Floats) -> Floats:
    return np.concatenate([normal, np.cross(point, normal)])


def motion_at(s: Floats, point: Floats) -> Floats:
    return s[:3] + np.cross(s[3:], point)


def loss(s: Floats, world: World) -> float:
    x, r = s[:3], world.gyration * s[3:]
    return float((np.sqrt(x @ x + SMOOTH**2) + np.sqrt(r @ r + SMOOTH**2)) / world.step)


def direct(contacts: Contacts, s0: Floats, world: World, passes: int = 60) -> Floats:
    """Compliant contact: fixed point of the reweighted least squares."""
    s = s0.copy()
    for _ in range(passes):
        a, rhs = world.mass, world.mass @ s0
        for p, n, rho, w in zip(contacts.points, contacts.normals, contacts.distances, contacts.weights, strict=True):
            u = motion_at(s, p)
            c = world.dilation - rho + n @ u
            if c <= 0:
                continue
            k = float(world.stiffness * w)
            tangent = u - (n @ u) * n
            slide = min(k, k * world.friction * float(c) / max(float(np.linalg.norm(tangent)), 1e-9))
            j = row(n, p)
            a = a + k * np.outer(j, j)
            rhs = rhs - k * (world.dilation - rho) * j
            for e in np.eye(3):
                jt = row(e - (n @ e) * n, p)
                a = a + slide * np.outer(jt, jt)
        s = np.asarray(np.linalg.solve(a, rhs), float)
    return s


def gauss_seidel(contacts: Contacts, s0: Floats, world: World) -> tuple[Floats, list[tuple[float, float]]]:
    """One sweep of position-based dynamics with Coulomb friction; also (normal, tangential) impulses per contact."""
    inverse = np.linalg.inv(world.mass)
    s = s0.copy()
    impulses = []
    for p, n, rho in zip(contacts.points, contacts.normals, contacts.distances, strict=True):
        j = row(n, p)
        c = world.dilation - rho + j @ s
        if c <= 0:
            impulses.append((0.0, 0.0))
            continue
        impulse = c / (j @ inverse @ j)
        s = s - impulse * (inverse @ j)
        u = motion_at(s, p)
        tangent = u - (n @ u) * n
        length = np.linalg.norm(tangent)
        slip = 0.0
        if length > 1e-9:
            jt = row(tangent / length, p)
            slip = min(length / (jt @ inverse @ jt), world.friction * impulse)
            s = s - slip * (inverse @ jt)
        impulses.append((impulse, slip))
    return s, impulses


def jacobi(contacts: Contacts, s0: Floats, world: World, passes: int) -> Floats:
    """Averaged corrections of all active contacts, `passes` times."""
    inverse = np.linalg.inv(world.mass)
    s = s0.copy()
    for _ in range(passes):
        total, active = np.zeros(6), 0
        for p, n, rho in zip(contacts.points, contacts.normals, contacts.distances, strict=True):
            j = row(n, p)
            c = world.dilation - rho + j @ s
            if c <= 0:
                continue
            active += 1
            impulse = c / (j @ inverse @ j)
            total -= impulse * (inverse @ j)
            u = motion_at(s, p)
            tangent = u - (n @ u) * n
            length = np.linalg.norm(tangent)
            if length > 1e-9:
                jt = row(tangent / length, p)
                total -= min(length / (jt @ inverse @ jt), world.friction * impulse) * (inverse @ jt)
        if active:
            s = s + total / active
    return s
