"""Mass properties of a closed mesh, exact for its triangles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.model.transforms import Floats

Ints = NDArray[np.int32] | NDArray[np.int64]


@dataclass(frozen=True)
class MassProperties:
    """Volume [m^3], centre of mass (3,) [m], inertia (3, 3) about it per unit of mass [m^2]."""

    volume: float
    centre_of_mass: Floats
    inertia: Floats


def mass_properties(vertices: Floats, faces: Ints) -> MassProperties:
    """Volume integrals summed over the tetrahedra between the faces and one point (Tonon 2004).

    The point is the mean vertex, so that a mesh far from its origin loses no digits.
    """
    origin = vertices.mean(axis=0)
    a, b, c = np.moveaxis(vertices[faces] - origin, 1, 0)
    six_volumes = np.einsum("ij,ij->i", a, np.cross(b, c))
    volume = float(six_volumes.sum() / 6)
    first = (six_volumes[:, None] * (a + b + c)).sum(axis=0) / 24
    centre = first / volume
    # Second moment of a tetrahedron with one corner at 0: V/20 (sum of outer products + outer product of the sum).
    total = a + b + c
    weight = six_volumes / 120
    second = sum(np.einsum("i,ij,ik->jk", weight, p, p) for p in (a, b, c, total))
    covariance = np.asarray(second) / volume - np.outer(centre, centre)
    inertia = np.trace(covariance) * np.eye(3) - covariance
    return MassProperties(volume, origin + centre, (inertia + inertia.T) / 2)


def signed_volume(vertices: Floats, faces: Ints) -> float:
    """Volume [m^3]; negative for a closed mesh that is wound inwards."""
    a, b, c = np.moveaxis(vertices[faces] - vertices[faces[0, 0]], 1, 0)
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)
