"""Model of an object for the engine: a closed, outward, simplified triangle mesh with mass properties.

All data are in metres and in the frame of the uploaded mesh. `ObjectModel.centred` has its origin at the mesh's middle,
for the engine: see `worker.objects.mesh_geometry`."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.errors import MeshError
from graspd.service.model.matter import FRICTION, MASS_KG, MOST_KG
from graspd.service.model.transforms import Floats
from graspd.worker.objects.disk_cache import NOT_CONTENT, TOLD_IF_SET, content_digest
from graspd.worker.objects.parts import SurfaceParts

Ints = NDArray[np.int32]


@dataclass(frozen=True)
class ObjectModel:
    name: str
    digest: str
    vertices: Floats  # (V, 3) [m]
    faces: Ints  # (F, 3) counter-clockwise from outside
    corner_normals: Floats
    """(F, 3, 3) unit normals per face corner, averaged over faces that meet below the crease angle."""
    volume: float  # [m^3]
    centre_of_mass: Floats  # (3,) at uniform density [m]
    inertia: Floats  # (3, 3) about the centre of mass, per unit of mass [m^2]
    radius: float  # largest distance of a vertex from the centre of mass [m]
    hull_vertices: Floats  # (H, 3) corners of the convex hull [m]
    hull_faces: Ints  # (G, 3) outward
    watertight: bool = True
    deviation_m: float = 0.0  # largest distance between the prepared surface and the uploaded one [m]
    repairs: tuple[str, ...] = ()
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)  # middle of the mesh [m]; zero for a model that is `centred`
    mass: float = field(default=MASS_KG, metadata=TOLD_IF_SET)  # [kg]
    friction: float = field(default=FRICTION, metadata=TOLD_IF_SET)  # Coulomb coefficient of its contacts in simulation
    parts: SurfaceParts | None = field(default=None, repr=False, metadata=NOT_CONTENT)
    """Named and coloured parts of the uploaded mesh, for contact regions; None for one part in one colour."""
    about_centre: Floats | None = field(default=None, repr=False)
    """(V + H + 1, 3) vertices, hull and centre of mass relative to the middle [m]; None if centred."""

    @cached_property
    def content(self) -> str:
        """Digest of the prepared model; `digest` is that of the file, equal for every fidelity."""
        return content_digest(self)

    @property
    def centred(self) -> ObjectModel:
        """The object in a frame at its middle: the same bits for any origin of the file."""
        return self if self.about_centre is None else self._with_points(self.about_centre, (0.0, 0.0, 0.0), None)

    def place_at(self, centre: tuple[float, float, float]) -> ObjectModel:
        """Return a centred object in a frame in which the object's middle is at `centre` [m]."""
        points = np.concatenate([self.vertices, self.hull_vertices, self.centre_of_mass[None]])
        return self._with_points(points + centre, centre, points) if any(centre) else self

    def _with_points(self, points: Floats, centre: tuple[float, float, float], held: Floats | None) -> ObjectModel:
        vertices, hull, mass = points[: len(self.vertices)], points[len(self.vertices) : -1], points[-1]
        return replace(
            self, vertices=vertices, hull_vertices=hull, centre_of_mass=mass, centre=centre, about_centre=held
        )

    def with_mass(
        self, *, mass: float | None = None, density: float | None = None, friction: float | None = None
    ) -> ObjectModel:
        """Return the object with another mass [kg], or density [kg/m^3], and friction; None changes nothing.
        Raises MeshError: the mass would exceed `MOST_KG`."""
        if mass is None:
            mass = self.mass if density is None else density * self.volume
        if mass > MOST_KG:
            raise MeshError(f"the object would weigh {mass:.4g} kg, more than {MOST_KG:g} kg; check its unit")
        friction = self.friction if friction is None else friction
        return self if (mass, friction) == (self.mass, self.friction) else replace(self, mass=mass, friction=friction)

    @property
    def for_dexgraspbench(self) -> ObjectModel:
        """Return the object with mass and friction of DexGraspBench's protocol, equal for all objects."""
        return self.with_mass(mass=MASS_KG, friction=FRICTION)

    @property
    def gyration_radius(self) -> float:
        """Length that weighs rotation against translation: sqrt(trace(inertia) / 3) [m]."""
        return float(np.sqrt(np.trace(self.inertia) / 3.0))
