"""Model of a simulation: everything that stays constant while hands move."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

import numpy as np
import warp as wp
from numpy.typing import NDArray

from graspd.service.model.errors import InputError
from graspd.service.model.transforms import Floats
from graspd.worker.hands.digits import points_of_parts
from graspd.worker.hands.model import HandModel, SurfacePoints
from graspd.worker.objects.region import WHOLE, ContactRegion
from graspd.worker.simulation.device import DeviceHand, DeviceObject, bounding_ball
from graspd.worker.simulation.kernels import contact, pieces, surface
from graspd.worker.simulation.obstacles import DeviceObstacles

#: Weights of points are areas in units of 1/800 of the hand's surface: the loss is independent of the points' number.
REFERENCE_POINTS: Final = 800
REFERENCE_SAMPLES: Final = 2000  # number of object samples at which each has weight 1
#: Number of hand points for tests against other links at which each point has weight 1.
REFERENCE_SELF_POINTS: Final = 1000
SOLVERS: Final = {"direct": contact.direct, "gauss_seidel": contact.gauss_seidel}
NEAR_GAP: Final = 4e-3  # largest gap of contacts in the direct solver's near list: four steps of the object [m]
CPU_LANE: Final = 64  # points per thread on the CPU, where starting a thread costs as much as a point; on CUDA 1
MAX_DILATION: Final = 0.1  # largest dilation of a schedule [m]
NO_CONTACT_M: Final = 4e-3  # clearance of points that must not touch: twice the distance that counts as contact [m]


@dataclass(frozen=True)
class LossOptions:
    """Options of simulation and penalties; see `worker.simulation.kernels.contact` for the symbols."""

    contact_solver: str = "direct"
    velocities: int = 7
    friction: float = 0.8
    stiffness: float = 1.0
    passes: int = 4
    step: float = 1e-3  # free motion of the object in one step, v dt [m]
    leak: float = 0.1
    leak_length: float = 0.02
    one_sided: bool = True
    band: float = 0.03  # points farther than dilation + band from the surface are ignored [m]
    exact_below: float = 0.004  # distances below this are computed from the mesh, above from the grid [m]
    range_weight: float = 0.005
    limit_weight: float = 0.0
    self_margin: float = 1e-3
    pull: float = 0.0
    """Depth at which penetration has the same force as the attraction of points without contact [m].
    The attraction fades with their distance."""
    pull_length: float = 0.013  # distance over which the attraction falls to 1/e [m]
    simulate: bool = True  # if False, every point near the object is attracted instead: a control for benchmarks


@dataclass(frozen=True)
class AllowedContacts:
    """Contacts that a grasp may have: parts of the hand, and a region of the object."""

    parts: NDArray[np.int32] | None = None
    """(L,) `Part` of each body that may touch; None: all."""
    region: ContactRegion = WHOLE

    def points(self, hand: HandModel, points: SurfacePoints) -> NDArray[np.bool_]:
        return np.ones(len(points), bool) if self.parts is None else points_of_parts(hand, self.parts, points)

    def regions(self, origin: Floats) -> Any:
        """Upload the regions relative to `origin` (3,) to the current device."""
        out = surface.ContactRegions()
        for name, given in (("allowed", self.region.touch), ("forbidden", self.region.avoid)):
            planes = np.zeros((0, 4))
            if isinstance(given, np.ndarray):
                planes = given - [0, 0, 0, 1] * (given[:, :3] @ origin)[:, None]
            setattr(out, name, wp.array(planes, dtype=wp.vec4, ndim=1))
        voxels = self.region.forbidden
        closed = np.zeros((0, 0, 0), np.uint8) if voxels is None else voxels.inside.astype(np.uint8)
        out.closed = wp.array(closed, dtype=wp.uint8, ndim=3)
        if voxels is not None:
            out.origin, out.cell = wp.vec3(*(voxels.origin - origin)), voxels.cell
        out.clearance = 0.0 if self is ANYWHERE else NO_CONTACT_M
        return out


ANYWHERE: Final = AllowedContacts()


@dataclass(frozen=True)
class Model:
    """A hand with one set of points, an object on a device, and the options of their simulation."""

    hand: DeviceHand
    obj: DeviceObject
    options: LossOptions
    obstacles: DeviceObstacles | None  # obstacles that the hands must avoid; None without obstacles
    count: int  # number of hand points
    point_body: Any
    point_position: Any
    point_weight: Any
    body_points: Any  # points tested against other links
    self_scale: float  # weight of one body point
    physics: Any
    motions: Any  # (M,) free motions of the object
    regions: Any  # `surface.ContactRegions`

    @staticmethod
    def create(
        hand: DeviceHand,
        obj: DeviceObject,
        points: SurfacePoints,
        self_points: SurfacePoints,
        options: LossOptions,
        obstacles: DeviceObstacles | None = None,
        allowed: AllowedContacts = ANYWHERE,
    ) -> Model:
        """Create the model with arrays on the hand's device.
        Raises InputError: unknown contact solver, or limits on contacts for another solver than `direct`."""
        if options.contact_solver not in SOLVERS:
            raise InputError(f"unknown contact solver {options.contact_solver!r}; choose one of {', '.join(SOLVERS)}")
        if allowed is not ANYWHERE and options.contact_solver != "direct":
            raise InputError(f"contact solver {options.contact_solver} allows contact anywhere: use direct")
        weight = points.area * (REFERENCE_POINTS / points.area.sum())
        weight = np.where(allowed.points(hand.model, points), weight, -weight)
        motions = initial_motions(options.velocities, options.step, obj.model.gyration_radius)
        with wp.ScopedDevice(hand.device):
            return Model(
                hand=hand,
                obj=obj,
                options=options,
                obstacles=obstacles,
                count=len(points),
                point_body=wp.array(points.body, dtype=wp.int32),
                point_position=wp.array(points.position, dtype=wp.vec3),
                point_weight=wp.array(weight, dtype=wp.float32),
                body_points=body_points(self_points, hand.model.bodies),
                self_scale=REFERENCE_SELF_POINTS / max(len(self_points), 1),
                physics=_physics(obj, options),
                motions=wp.array(motions, dtype=contact.vec6),
                regions=allowed.regions(obj.model.centre_of_mass),
            )

    @property
    def device(self) -> str:
        return self.hand.device

    @property
    def lane(self) -> int:
        """Points of a hand per thread."""
        return 1 if wp.get_device(self.device).is_cuda else CPU_LANE

    @property
    def lanes(self) -> int:
        return -(-self.count // self.lane)

    @property
    def dofs(self) -> int:
        return self.hand.model.dofs

    @property
    def bodies(self) -> int:
        return self.hand.model.bodies

    @property
    def pieces(self) -> int:
        return len(self.hand.model.pieces)


def initial_motions(velocities: int, step: float, gyration: float) -> Floats:
    """Return free motions (M, 6): rest, +-x, +-y, +-z, and for M = 13 also rotations +-x, +-y, +-z."""
    rows = [np.zeros(6)]
    for axis in range(3 if velocities == 7 else 6):
        for sign in (1.0, -1.0):
            motion = np.zeros(6)
            motion[axis] = sign * (step if axis < 3 else step / gyration)
            rows.append(motion)
    return np.array(rows)


def body_points(points: SurfacePoints, bodies: int) -> Any:
    """Return the points sorted by body, with bounding spheres."""
    order = np.argsort(points.body, kind="stable")
    body, position = points.body[order], points.position[order]
    first = np.searchsorted(body, np.arange(bodies + 1))
    own = [position[start:end] for start, end in pairwise(first)]
    centre, radius = zip(*map(bounding_ball, own), strict=True)
    extent = [np.linalg.norm(points, axis=1).max(initial=0.0) for points in own]
    out = pieces.BodyPoints()
    out.first = wp.array(first, dtype=wp.int32)
    out.position = wp.array(position, dtype=wp.vec3)
    out.centre = wp.array(np.array(centre), dtype=wp.vec3)
    out.radius = wp.array(radius, dtype=wp.float32)
    out.extent = wp.array(extent, dtype=wp.float32)
    return out


def _physics(obj: DeviceObject, options: LossOptions) -> Any:
    mass = np.zeros((6, 6))
    mass[:3, :3] = np.eye(3)
    mass[3:, 3:] = obj.model.inertia
    physics = contact.Physics()
    physics.mass = contact.mat66(*mass.ravel().tolist())
    physics.inverse_mass = contact.mat66(*np.linalg.inv(mass).ravel().tolist())
    physics.gyration = obj.model.gyration_radius
    for name in ("friction", "stiffness", "leak", "leak_length", "step"):
        setattr(physics, name, getattr(options, name))
    physics.one_sided = int(options.one_sided)
    physics.near_gap = NEAR_GAP
    physics.radius = obj.model.radius + options.band + MAX_DILATION
    return physics
