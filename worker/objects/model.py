"""An object as the engine sees it: one closed, outward, simplified triangle mesh with its mass properties.

Everything is in the object frame: the frame of the mesh as uploaded, in metres.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from worker.objects.content import content_of

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]


@dataclass(frozen=True)
class ObjectModel:
    """A prepared object. Mass scales out: inertia is per unit of mass."""

    name: str
    digest: str
    vertices: Floats
    """(V, 3) [m]"""
    faces: Ints
    """(F, 3) counter-clockwise from outside."""
    corner_normals: Floats
    """(F, 3, 3) unit normal per face corner, averaged only over faces that meet at less than the crease angle."""
    volume: float
    """[m^3]"""
    centre_of_mass: Floats
    """(3,) at uniform density [m]."""
    inertia: Floats
    """(3, 3) about the centre of mass, per unit of mass [m^2]."""
    radius: float
    """Largest distance of a vertex from the centre of mass [m]."""
    hull_vertices: Floats
    """(H, 3) corners of the convex hull [m]."""
    hull_faces: Ints
    """(G, 3) outward."""
    watertight: bool = True
    deviation_m: float = 0.0
    """Largest distance between the prepared surface and the uploaded one [m]."""
    repairs: tuple[str, ...] = ()

    @cached_property
    def content(self) -> str:
        """Digest of what was prepared. `digest` is the file's: the same for every fidelity."""
        return content_of(self)

    @property
    def gyration_radius(self) -> float:
        """Length that weighs rotation against translation: sqrt(trace(inertia) / 3) [m]."""
        return float(np.sqrt(np.trace(self.inertia) / 3.0))
