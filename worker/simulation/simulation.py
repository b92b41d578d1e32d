"""B grasps of one hand on one object: one iteration is gradient of the loss, then a step; nothing leaves the device.

All per-iteration values (dilation, weights, rates) lie in tables on the device, read at a counter on the device, so an
iteration is the same list of launches each time: recorded once, and replayed as a graph on CUDA.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import warp as wp
from numpy.typing import NDArray

from service.model.errors import InputError
from worker.hands.model import SurfacePoints
from worker.simulation.device import DeviceHand, DeviceObject, to_wxyz, to_xyzw
from worker.simulation.kernels import contact, kinematics, optimizers, penalties, pieces, surface
from worker.simulation.kernels import obstacles as obstacle_kernels
from worker.simulation.launches import Launches
from worker.simulation.obstacles import DeviceObstacles

Floats = NDArray[np.float64]

#: Weights of points are areas in units of 1/800 of the hand's surface: the loss does not depend on how many points.
REFERENCE_POINTS: Final = 800
#: Weight of one object sample is 1 at this many samples.
REFERENCE_SAMPLES: Final = 2000
#: Weight of one hand point against other links is 1 at this many.
REFERENCE_SELF_POINTS: Final = 1000
#: Names that `Simulation.record_iteration` knows.
OPTIMIZERS: Final = ("adam", "gd")
#: Kernels of the contact step by their names.
_SOLVERS: Final = {"direct": contact.direct, "jacobi": contact.jacobi, "gauss_seidel": contact.gauss_seidel}
#: Largest dilation a schedule may ask for [m].
MAX_DILATION: Final = 0.1


@dataclass(frozen=True)
class LossOptions:
    """What is simulated and penalised; see `worker.simulation.kernels.contact` for the symbols."""

    contact_solver: str = "direct"
    velocities: int = 7
    friction: float = 0.8
    stiffness: float = 1.0
    passes: int = 4
    step: float = 1e-3
    """Free motion of the object in one step, v dt [m]."""
    leak: float = 0.1
    leak_length: float = 0.02
    one_sided: bool = True
    band: float = 0.03
    """Points farther than dilation + band from the surface take no part [m]."""
    exact_below: float = 0.004
    """Nearer than this distances are asked of the mesh, farther of the grid [m]."""
    range_weight: float = 0.005
    limit_weight: float = 0.0
    self_margin: float = 1e-3
    simulate: bool = True
    """False: no simulation; every point near the object is drawn to it. A control for benchmarks."""


@dataclass(frozen=True)
class Schedule:
    """Per-iteration values, arrays of length I; rates (I, 3) for translation [m], rotation [rad], joints."""

    dilation: Floats
    penetration: Floats
    object_penetration: Floats
    self_penetration: Floats
    rates: Floats

    def __len__(self) -> int:
        return len(self.dilation)


def still_schedule() -> Schedule:
    """Tables for telling distances and depths only: no dilation, no weights, no step."""
    zero = np.zeros(1)
    return Schedule(zero, zero, zero, zero, np.zeros((1, 3)))


@dataclass
class HandState:
    """State of B hands: pivot (B, 3) = palm centre relative to the object's centre of mass, rotation (B, 4) w x y z,
    q (B, D)."""

    pivot: Floats
    rotation: Floats
    q: Floats

    def __getitem__(self, index: Any) -> HandState:
        return HandState(self.pivot[index], self.rotation[index], self.q[index])


def initial_motions(velocities: int, step: float, gyration: float) -> Floats:
    """(M, 6) free motions of the object: at rest, then +-x, +-y, +-z, then (13) the same for rotations."""
    rows = [np.zeros(6)]
    for axis in range(3 if velocities == 7 else 6):
        for sign in (1.0, -1.0):
            motion = np.zeros(6)
            motion[axis] = sign * (step if axis < 3 else step / gyration)
            rows.append(motion)
    return np.array(rows)


def body_points(points: SurfacePoints, bodies: int) -> Any:
    """The points sorted by body, with bounding spheres."""
    order = np.argsort(points.body, kind="stable")
    body, position = points.body[order], points.position[order]
    first = np.searchsorted(body, np.arange(bodies + 1))
    centre, radius = np.zeros((bodies, 3)), np.zeros(bodies)
    for k in range(bodies):
        own = position[first[k] : first[k + 1]]
        if len(own):
            centre[k] = (own.min(axis=0) + own.max(axis=0)) / 2
            radius[k] = np.linalg.norm(own - centre[k], axis=1).max()
    out = pieces.BodyPoints()
    out.first = wp.array(first, dtype=wp.int32)
    out.position = wp.array(position, dtype=wp.vec3)
    out.centre = wp.array(centre, dtype=wp.vec3)
    out.radius = wp.array(radius, dtype=wp.float32)
    return out


class Simulation:
    """Arrays and launches for up to `capacity` grasps with one set of hand points."""

    def __init__(
        self, hand: DeviceHand, obj: DeviceObject, points: SurfacePoints, self_points: SurfacePoints,
        *, capacity: int, options: LossOptions, obstacles: DeviceObstacles | None = None,
    ) -> None:  # fmt: skip
        if options.contact_solver not in _SOLVERS:
            raise InputError(f"unknown contact solver {options.contact_solver!r}; choose one of {', '.join(_SOLVERS)}")
        self.hand, self.obj, self.options, self.capacity = hand, obj, options, capacity
        self.device = hand.device
        self.dofs, self.bodies, self.count = hand.model.dofs, hand.model.bodies, len(points)
        self.obstacles = obstacles
        """What the hands must stay clear of; None: nothing."""
        self.room = 0.0
        """Distance to keep besides each feature's margin [m]."""
        self.launches = Launches(self.device)
        with wp.ScopedDevice(self.device):
            self._upload_points(points, self_points)
            self._allocate()
            self.physics = self._physics()

    def _upload_points(self, points: SurfacePoints, self_points: SurfacePoints) -> None:
        weight = points.area * (REFERENCE_POINTS / points.area.sum())
        self.point_body = wp.array(points.body, dtype=wp.int32)
        self.point_position = wp.array(points.position, dtype=wp.vec3)
        self.point_weight = wp.array(weight, dtype=wp.float32)
        self.body_points = body_points(self_points, self.bodies)
        self.self_scale = REFERENCE_SELF_POINTS / max(len(self_points), 1)

    def _allocate(self) -> None:
        B, N, L, D = self.capacity, self.count, self.bodies, self.dofs
        M = self.options.velocities
        self.active = wp.ones(B, dtype=wp.int32)
        self.iteration = wp.zeros(1, dtype=wp.int32)
        self.dilation_scale = wp.ones(B, dtype=wp.float32)
        self.pivot = wp.zeros(B, dtype=wp.vec3)
        self.rotation = wp.zeros(B, dtype=wp.quat)
        self.q = wp.zeros((B, D), dtype=wp.float32)
        self.body_p = wp.zeros((B, L), dtype=wp.vec3)
        self.body_q = wp.zeros((B, L), dtype=wp.quat)
        self.axis = wp.zeros((B, L), dtype=wp.vec3)
        self.force = wp.zeros((B, L), dtype=wp.vec3)
        self.torque = wp.zeros((B, L), dtype=wp.vec3)
        self.contacts = wp.zeros(B, dtype=wp.int32)
        self.contact_body = wp.zeros((B, N), dtype=wp.int32)
        self.contact_point = wp.zeros((B, N), dtype=wp.vec3)
        self.contact_normal = wp.zeros((B, N), dtype=wp.vec3)
        self.contact_distance = wp.zeros((B, N), dtype=wp.float32)
        self.contact_weight = wp.zeros((B, N), dtype=wp.float32)
        self.contact_gradient = wp.zeros((B, N), dtype=wp.float32)
        self.loss = wp.zeros((B, M), dtype=wp.float32)
        self.end = wp.zeros((B, M), dtype=contact.vec6)
        self.gradient = wp.zeros((B, 6 + D), dtype=wp.float32)
        self.first = wp.zeros((B, 6 + D), dtype=wp.float32)
        self.second = wp.zeros((B, 6 + D), dtype=wp.float32)
        self.best = wp.zeros(B, dtype=wp.float32)
        self.waited = wp.zeros(B, dtype=wp.int32)
        self.point_depth = wp.zeros(B, dtype=wp.float32)
        self.object_depth = wp.zeros(B, dtype=wp.float32)
        self.self_depth = wp.zeros(B, dtype=wp.float32)
        self.obstacle_depth = wp.zeros(B, dtype=wp.float32)
        self.scene = wp.full(B, -1, dtype=wp.int32)
        motions = initial_motions(M, self.options.step, self.obj.model.gyration_radius)
        self.motions = wp.array(motions, dtype=contact.vec6)
        self.states = None
        if self.options.contact_solver != "direct":
            kept = N if self.options.contact_solver == "gauss_seidel" else self.options.passes
            self.states = wp.zeros((B, M, kept), dtype=contact.vec6)

    def _physics(self) -> Any:
        mass = np.zeros((6, 6))
        mass[:3, :3] = np.eye(3)
        mass[3:, 3:] = self.obj.model.inertia
        physics = contact.Physics()
        physics.mass = contact.mat66(*mass.ravel().tolist())
        physics.inverse_mass = contact.mat66(*np.linalg.inv(mass).ravel().tolist())
        physics.gyration = self.obj.model.gyration_radius
        physics.friction = self.options.friction
        physics.stiffness = self.options.stiffness
        physics.leak = self.options.leak
        physics.leak_length = self.options.leak_length
        physics.one_sided = int(self.options.one_sided)
        physics.step = self.options.step
        physics.radius = self.obj.model.radius + self.options.band + MAX_DILATION
        return physics

    def set_state(
        self, state: HandState, active: NDArray[np.bool_] | None = None, dilation: Floats | None = None
    ) -> None:
        """Load up to `capacity` hands; the rest of the capacity is switched off. Optimiser moments are cleared.

        `dilation` (n,) multiplies the schedule's dilation for each hand; 1 where it is not given.
        """
        n = len(state.pivot)
        scale = np.ones(self.capacity, dtype=np.float32)
        if dilation is not None:
            scale[:n] = dilation
        self.dilation_scale.assign(scale)
        mask = np.zeros(self.capacity, dtype=np.int32)
        mask[:n] = 1 if active is None else active
        self._assign(self.pivot, state.pivot)
        self._assign(self.rotation, to_xyzw(state.rotation))
        self._assign(self.q, state.q)
        self.active.assign(mask)
        self.iteration.zero_()
        self.first.zero_()
        self.second.zero_()
        self.best.fill_(1e9)
        self.waited.zero_()

    def set_scenes(self, index: NDArray[np.integer[Any]]) -> None:
        """The scene (n,) of each hand, among those of `obstacles`; -1: none. It stays when states change."""
        padded = np.full(self.capacity, -1, dtype=np.int32)
        padded[: len(index)] = index
        self.scene.assign(padded)

    def depths(self, n: int) -> Floats:
        """(n,) deepest penetration of each hand at the last evaluation [m]: into the object, of the object into links,
        of links into links, and what it lacks of its distance from obstacles."""
        parts = (self.point_depth, self.object_depth, self.self_depth, self.obstacle_depth)
        return np.max([part.numpy()[:n] for part in parts], axis=0)

    def _assign(self, array: Any, values: Floats) -> None:
        padded = np.zeros((self.capacity, values.shape[1]), dtype=np.float32)
        padded[: len(values)] = values
        array.assign(padded)

    def state(self, n: int) -> HandState:
        """The first n hands, in float64."""
        return HandState(
            self.pivot.numpy()[:n].astype(float),
            to_wxyz(self.rotation.numpy()[:n].astype(float)),
            self.q.numpy()[:n].astype(float),
        )

    def set_schedule(self, schedule: Schedule) -> None:
        """Upload the per-iteration tables and start counting at 0.

        Raises:
            ValueError: a dilation above `MAX_DILATION`.
        """
        if len(schedule) and schedule.dilation.max() > MAX_DILATION:
            raise ValueError(f"the dilation may be at most {MAX_DILATION} m")
        with wp.ScopedDevice(self.device):
            self.dilation = wp.array(schedule.dilation, dtype=wp.float32)
            self.penetration_weight = wp.array(schedule.penetration, dtype=wp.float32)
            self.object_weight = wp.array(schedule.object_penetration, dtype=wp.float32)
            self.self_weight = wp.array(schedule.self_penetration, dtype=wp.float32)
            self.rates = wp.array(schedule.rates, dtype=wp.float32)
        self.launches = Launches(self.device)

    def commands(self) -> list[tuple[str, Any]]:
        """Name and launch of each kernel of what was recorded, in order."""
        return self.launches.named()

    def _record_kinematics(self) -> None:
        B = self.capacity
        self.launches.add(
            kinematics.forward, B,
            inputs=[self.hand.tree, self.active, self.pivot, self.rotation, self.q],
            outputs=[self.body_p, self.body_q, self.axis, self.force, self.torque, self.contacts, self.point_depth,
                     self.object_depth, self.self_depth],
        )  # fmt: skip
        self._record_gather()

    def _record_gather(self) -> None:
        self.launches.add(
            surface.gather, (self.capacity, self.count),
            inputs=[self.obj.surface, self.options.band, self.options.exact_below, self.point_body,
                    self.point_position, self.point_weight, self.active, self.iteration, self.dilation,
                    self.dilation_scale, self.body_p, self.body_q],
            outputs=[self.contacts, self.contact_body, self.contact_point, self.contact_normal,
                     self.contact_distance, self.contact_weight, self.contact_gradient],
        )  # fmt: skip

    def _record_contact(self) -> None:
        o = self.options
        inputs = [
            self.physics, self.motions, o.passes, self.active, self.iteration, self.dilation, self.dilation_scale,
            self.contacts,
            self.contact_point, self.contact_normal, self.contact_distance, self.contact_weight,
        ]  # fmt: skip
        scratch = [] if self.states is None else [self.states]
        if o.simulate:
            self.launches.add(
                _SOLVERS[o.contact_solver], (self.capacity, o.velocities),
                inputs=inputs, outputs=[*scratch, self.loss, self.end, self.contact_gradient],
            )  # fmt: skip
        else:
            self.launches.add(
                penalties.attract, (self.capacity, self.count),
                inputs=[o.leak, o.leak_length, self.active, self.contacts, self.contact_distance, self.contact_weight],
                outputs=[self.contact_gradient],
            )  # fmt: skip

    def _record_penalties(self) -> None:
        B, o = self.capacity, self.options
        pose, wrench = [self.body_p, self.body_q], [self.force, self.torque]
        self.launches.add(
            pieces.object_in_pieces, (B, len(self.hand.model.pieces)),
            inputs=[self.hand.pieces, self.obj.bvh.id, self.obj.samples, REFERENCE_SAMPLES / len(self.obj.samples),
                    self.active, self.iteration, self.object_weight, *pose],
            outputs=[*wrench, self.object_depth],
        )  # fmt: skip
        self.launches.add(
            pieces.pieces_in_pieces, (B, len(self.hand.model.pieces)),
            inputs=[self.hand.pieces, self.body_points, self.self_scale, o.self_margin, self.active, self.iteration,
                    self.self_weight, *pose],
            outputs=[*wrench, self.self_depth],
        )  # fmt: skip
        self.launches.add(
            penalties.points_to_bodies, (B, self.count),
            inputs=[0.0, self.active, self.iteration, self.penetration_weight, self.contacts, self.contact_body,
                    self.contact_point, self.contact_normal, self.contact_distance, self.contact_weight,
                    self.contact_gradient],
            outputs=[*wrench, self.point_depth],
        )  # fmt: skip
        if self.obstacles is not None:
            self.launches.add(obstacle_kernels.clear, B, inputs=[self.active], outputs=[self.obstacle_depth])
            self.launches.add(
                obstacle_kernels.penalty, (B, self.obstacles.count),
                inputs=[self.obstacles.features, self.obstacles.solids, self.active, self.scene, self.iteration,
                        self.penetration_weight, *pose, self.room],
                outputs=[*wrench, self.obstacle_depth],
            )  # fmt: skip

    def _record_gradient(self) -> None:
        B, o = self.capacity, self.options
        self.launches.add(
            kinematics.backward, B,
            inputs=[self.hand.tree, self.active, self.pivot, self.body_p, self.axis],
            outputs=[self.force, self.torque, self.gradient],
        )  # fmt: skip
        self.launches.add(
            penalties.joints, (B, self.dofs),
            inputs=[self.hand.lower, self.hand.upper, o.range_weight, o.limit_weight, self.active, self.q],
            outputs=[self.gradient],
        )  # fmt: skip

    def record_iteration(self, optimizer: str, *, betas: tuple[float, float] = (0.9, 0.99), patience: int = 0) -> None:
        """Fix the launches of one iteration for the present schedule.

        With a `patience`, a grasp that has not improved for so many iterations is switched off and costs nothing more.

        Raises:
            InputError: unknown optimizer.
        """
        if optimizer not in OPTIMIZERS:
            raise InputError(f"unknown optimizer {optimizer!r}; choose one of {', '.join(OPTIMIZERS)}")
        self.launches = Launches(self.device)
        self._record_kinematics()
        self._record_contact()
        self._record_penalties()
        self._record_gradient()
        inputs = [self.hand.lower, self.hand.upper, self.active, self.iteration, self.rates, self.gradient]
        state = [self.pivot, self.rotation, self.q]
        if optimizer == "adam":
            self.launches.add(
                optimizers.adam, self.capacity, inputs=[*inputs, *betas], outputs=[self.first, self.second, *state]
            )
        else:
            clamp = int(self.options.limit_weight == 0.0)
            self.launches.add(optimizers.gradient_descent, self.capacity, inputs=[*inputs, clamp], outputs=state)
        if patience:
            self.launches.add(
                optimizers.converge, self.capacity,
                inputs=[self.loss, self.point_depth, self.object_depth, self.self_depth, patience],
                outputs=[self.best, self.waited, self.active],
            )  # fmt: skip
        self.launches.add(optimizers.advance, 1, inputs=[], outputs=[self.iteration])

    def record_placement(self) -> None:
        """Fix the launches that tell contacts and penetration depths only."""
        self.launches = Launches(self.device)
        self._record_kinematics()
        self._record_penalties()

    def run(self, iterations: int = 1) -> None:
        """Launch what was recorded, `iterations` times, without waiting for the device."""
        self.launches.run(iterations)
