"""Data of a simulation on its device: states of up to `capacity` hands, contacts, and schedules.

Values of an iteration (dilation, weights, rates) are rows of tables on the device, which a counter there selects. Every
iteration is therefore the same list of launches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import warp as wp
from numpy.typing import NDArray

from graspd.service.model.transforms import Floats
from graspd.worker.simulation.device import joint_units, to_wxyz, to_xyzw
from graspd.worker.simulation.kernels import contact, kinematics, packing, penalties
from graspd.worker.simulation.model import REFERENCE_POINTS, Model

#: Fields of `kinematics.Depths`, and fields of `kinematics.Hands`.
_DEPTHS: Final = ("points", "object", "links", "obstacles")
_HANDS: Final = (
    *("active", "iteration", "dilation_scale", "scene"),
    *("pivot", "rotation", "q", "body_p", "body_q", "axis", "wrench"),
)


class DeviceSchedule:
    """A schedule on the device, with one rate per dof: the joint rate times `unit` (D,)."""

    def __init__(self, schedule: Schedule, unit: Floats) -> None:
        tables = (schedule.dilation, schedule.penetration, schedule.object_penetration, schedule.self_penetration)
        self.dilation, self.penetration, self.object_penetration, self.self_penetration = (
            wp.array(table, dtype=wp.float32) for table in tables
        )
        joints = schedule.rates[:, 2:] * unit
        self.rates = wp.array(np.concatenate([schedule.rates[:, :2], joints], axis=1), dtype=wp.float32)


def allocate_contacts(capacity: int, points: int, *, marked: bool = False) -> Any:
    """Allocate `packing.Contacts` of shape (capacity, points), with an array of marks if `marked`."""
    out, shape = packing.Contacts(), (capacity, points)
    out.count, out.near_count = (wp.zeros(capacity, dtype=wp.int32) for _ in range(2))
    out.body, out.near = (wp.empty(shape, dtype=wp.int32) for _ in range(2))
    out.point, out.normal = (wp.empty(shape, dtype=wp.vec3) for _ in range(2))
    out.distance, out.weight, out.gradient = (wp.empty(shape, dtype=wp.float32) for _ in range(3))
    out.mark = wp.zeros(shape if marked else (0, 0), dtype=wp.int32)
    return out


class Data:
    """Arrays for up to `capacity` hands of a model; `worker.simulation.record` has the operations."""

    def __init__(self, model: Model, capacity: int, *, serial: bool | None = None) -> None:
        """`serial`: whether threads of a launch run in order, by default on a CPU.
        Otherwise contacts are packed in the order of their points, so that their sums do not depend on threads."""
        self.device, self.capacity = model.device, capacity
        self.serial = not wp.get_device(model.device).is_cuda if serial is None else serial
        self.unit = joint_units(model.hand.model)
        with wp.ScopedDevice(self.device):
            self.contacts = allocate_contacts(capacity, model.count)
            self.marked = None if self.serial else allocate_contacts(capacity, model.count, marked=True)
            chunks = (capacity, -(-model.count // packing.CHUNK))
            #: Number of contacts, and number of near contacts, in every chunk of marks (B, N / chunk).
            self.chunk_counts = [wp.zeros(chunks, dtype=wp.int32) for _ in range(2)]
            self.depths = kinematics.Depths()
            for kind in _DEPTHS:
                setattr(self.depths, kind, wp.zeros(capacity, dtype=wp.float32))
            self.schedule = DeviceSchedule(zero_schedule(), self.unit)
            self._allocate(capacity, model.bodies, model.dofs, model.options.velocities)
            #: Number of motions that the contact solver stores for its reverse sweep.
            kept = model.count if model.options.contact_solver == "gauss_seidel" else 0
            self.states = wp.zeros((capacity, model.options.velocities, kept), dtype=contact.vec6)

    def _allocate(self, B: int, L: int, D: int, M: int) -> None:
        self.active = wp.ones(B, dtype=wp.int32)
        self.iteration = wp.zeros(1, dtype=wp.int32)
        self.dilation_scale = wp.ones(B, dtype=wp.float32)
        self.scene = wp.full(B, -1, dtype=wp.int32)
        self.pivot = wp.zeros(B, dtype=wp.vec3)
        self.rotation = wp.zeros(B, dtype=wp.quat)
        self.q = wp.zeros((B, D), dtype=wp.float32)
        self.body_p = wp.zeros((B, L), dtype=wp.vec3)
        self.body_q = wp.zeros((B, L), dtype=wp.quat)
        self.axis = wp.zeros((B, L), dtype=wp.vec3)
        self.wrench = wp.zeros((B, L, 6), dtype=wp.int64)
        self.loss = wp.zeros((B, M), dtype=wp.float32)
        self.end, self.adjoint = (wp.zeros((B, M), dtype=contact.vec6) for _ in range(2))
        self.gradient, self.first, self.second = (wp.zeros((B, 6 + D), dtype=wp.float32) for _ in range(3))
        self.best, self.waited = wp.zeros(B, dtype=wp.float32), wp.zeros(B, dtype=wp.int32)
        self.hands = kinematics.Hands()  # the arrays `_HANDS` as a struct for kernels
        for name in _HANDS:
            setattr(self.hands, name, getattr(self, name))

    def set_state(self, state: HandState, *, dilation: Floats | None = None) -> None:
        """Load n hands, at most `capacity`; switch off all others, and reset the optimiser.
        `dilation` (n,) multiplies the schedule's dilation for each hand; by default 1."""
        n = len(state.pivot)
        scale = np.ones(self.capacity, dtype=np.float32)
        scale[:n] = 1.0 if dilation is None else dilation
        self.dilation_scale.assign(scale)
        self._assign(self.pivot, state.pivot)
        self._assign(self.rotation, to_xyzw(state.rotation))
        self._assign(self.q, state.q)
        self.active.assign((np.arange(self.capacity) < n).astype(np.int32))
        self.best.fill_(1e9)
        for array in (self.iteration, self.first, self.second, self.waited):
            array.zero_()

    def deactivate(self, hands: NDArray[np.bool_]) -> None:
        """Switch off the hands of a mask (n,): kernels skip them from the next iteration on."""
        active = self.active.numpy()
        active[: len(hands)][hands] = 0
        self.active.assign(active)

    def set_scenes(self, index: NDArray[np.integer[Any]]) -> None:
        """Set each hand's scene number `index` (n,), -1 without scene; `set_state` does not change it."""
        padded = np.full(self.capacity, -1, dtype=np.int32)
        padded[: len(index)] = index
        self.scene.assign(padded)

    def set_schedule(self, schedule: Schedule) -> None:
        """Upload a schedule, dilations up to `MAX_DILATION`; launches recorded before keep the former one."""
        with wp.ScopedDevice(self.device):
            self.schedule = DeviceSchedule(schedule, self.unit)

    def deepest_penetration(self, n: int) -> Floats:
        """Return the deepest penetration (n,) of the first n hands, as last evaluated [m]."""
        return np.max([getattr(self.depths, kind).numpy()[:n] for kind in _DEPTHS], axis=0)

    def near_share(self, reach: float, n: int) -> Floats:
        """Return the share (n,) of each hand's surface within `reach` [m] of the object, as last evaluated."""
        inputs = [reach, float(REFERENCE_POINTS), self.contacts]
        with wp.ScopedDevice(self.device):
            share = wp.empty(n, dtype=wp.float32)
            wp.launch(penalties.near_share, n, inputs=inputs, outputs=[share])
        return share.numpy().astype(float)

    def state(self, n: int) -> HandState:
        """Download the first n hands."""
        pivot, rotation, q = (array.numpy()[:n].astype(float) for array in (self.pivot, self.rotation, self.q))
        return HandState(pivot, to_wxyz(rotation), q)

    def _assign(self, array: Any, values: Floats) -> None:
        padded = np.zeros((self.capacity, values.shape[1]), dtype=np.float32)
        padded[: len(values)] = values
        array.assign(padded)


@dataclass
class HandState:
    """State of B hands."""

    pivot: Floats  # (B, 3) palm centre relative to the object's centre of mass [m]
    rotation: Floats  # (B, 4) w x y z
    q: Floats  # (B, D)

    def __getitem__(self, index: Any) -> HandState:
        return HandState(self.pivot[index], self.rotation[index], self.q[index])

    @classmethod
    def concatenate(cls, states: Sequence[HandState]) -> HandState:
        """Return the hands of several states, one state after the other."""
        return cls(*(np.concatenate([getattr(one, name) for one in states]) for name in ("pivot", "rotation", "q")))


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


def zero_schedule() -> Schedule:
    """Return a schedule of one iteration for distances and depths only: no dilation, weights or step."""
    zero = np.zeros(1)
    return Schedule(zero, zero, zero, zero, np.zeros((1, 3)))
