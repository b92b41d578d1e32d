"""GraspIt!'s autograsp: random collision-free start, approach, closing of the fingers until contact.

GraspIt! closes joints in small steps and moves back after a collision. Here distances limit the steps, so that no step
passes through the object. Both end in contact, here within `TOUCH_M`."""

import time
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import warp as wp
from numpy.typing import NDArray
from pydantic import Field

from graspd.baselines.autograsp import kernels
from graspd.baselines.common import collision_free_starts, create_grasp_set, load_pair
from graspd.service.model.transforms import Floats, quat_rotate
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.grasps import GraspSet
from graspd.worker.hands.kinematics import ancestors
from graspd.worker.hands.model import HandModel, JointType, SurfacePoints
from graspd.worker.objects.model import ObjectModel
from graspd.worker.planners.fast_graspd.pairs import Pair
from graspd.worker.planners.port import Method, Options, PlanRequest
from graspd.worker.planners.threads import StepCounter, run_parts, split_batch
from graspd.worker.simulation.data import Data, HandState
from graspd.worker.simulation.launches import Launches
from graspd.worker.simulation.model import Model
from graspd.worker.simulation.record import add_poses


class AutograspOptions(Options):
    standoff_m: float = Field(0.005, ge=0.0, le=0.05, description="gap at which the approach ends [m]")


@dataclass(frozen=True)
class Autograsp:
    options: AutograspOptions

    def __call__(self, hand: HandModel, obj: ObjectModel, wanted: PlanRequest, run: ExecutionContext) -> GraspSet:
        began = time.perf_counter()
        pair = load_pair(hand, obj, run.device, kernels)
        steps = StepCounter(3 * wanted.count, run)

        def work(indices: range) -> HandState:
            n = len(indices)
            state = collision_free_starts(pair, seed=wanted.seed, batch=wanted.batch, indices=indices)
            steps(n, "starts")
            closer = HandCloser(pair, n)
            state = closer.approach(state, self.options.standoff_m)
            steps(n, "approach")
            state = closer.close(state)
            steps(n, "closing")
            return state

        states = run_parts(split_batch(wanted.count, run), work)
        return create_grasp_set(pair, HandState.concatenate(states), began, {})


METHOD: Final = Method(
    summary="a random approach, then the fingers close until contact",
    source="A. T. Miller and P. K. Allen, GraspIt!, IEEE Robotics and Automation Magazine 2004",
    planner=Autograsp,
    options=AutograspOptions,
    uses=("face_error_m",),
)

TOUCH_M: Final = 2e-4  # largest distance of a contact: GraspIt!'s threshold layer [m]
REACH_M: Final = 0.03  # largest distance that is computed [m]; larger ones are set to it
MARGIN_M: Final = 0.005  # gap between two bodies below which it limits the steps of their dofs [m]
#: Share of a gap that one step crosses. Large distances come from a grid and have errors of up to a third.
SHARE: Final = 0.6
#: Longest closing step [rad], and largest number of steps.
LARGEST: Final = 0.1
STEPS: Final = 400
#: Largest number of approach steps. Each step crosses more than half of the remaining distance.
ADVANCES: Final = 40


def lever_arm_bounds(hand: HandModel, points: SurfacePoints) -> Floats:
    """Return (D, L) bounds on the motion of body l's points per unit of dof d, by chain lengths [m/rad]."""
    radius = np.zeros(hand.bodies)
    np.maximum.at(radius, points.body, np.linalg.norm(points.position, axis=1))
    length = np.linalg.norm(hand.origin[:, :3], axis=1)
    moved = ancestors(hand)
    out = np.zeros((hand.dofs, hand.bodies))
    for joint in range(1, hand.bodies):
        for body in np.flatnonzero(moved[:, joint]):
            between = [k for k in range(1, hand.bodies) if moved[body, k] and moved[k, joint] and k != joint]
            turning = hand.joint_type[joint] == JointType.REVOLUTE
            reach = length[between].sum() + radius[body] if turning else 1.0
            out[hand.dof[joint], body] += abs(hand.multiplier[joint]) * reach
    return out


def finger_groups(moves: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Return group numbers (D,), equal for dofs that move a common body; `moves` is (D, L)."""
    group = np.arange(len(moves))
    for d in range(len(moves)):
        for e in range(d):
            if (moves[d] & moves[e]).any():
                group[group == group[d]] = group[e]
    return group.astype(np.int32)


class HandCloser:
    """Approach and closing of up to `capacity` hands.
    `stopped` (B, D) is 0 for a dof that still closes, 1 after contact, 2 at a limit or for a dof that never closes."""

    def __init__(self, pair: Pair, capacity: int) -> None:
        self.pair, self.capacity = pair, capacity
        self.hand = pair.hand.model
        self.model = Model.create(pair.hand, pair.fine.obj, pair.fine.points, pair.coarse.own, pair.options)
        # Only kinematics is computed.
        self.data = Data(self.model, capacity)
        self._poses = Launches(self.model.device)
        add_poses(self._poses, self.model, self.data)
        hand, points = self.hand, self.pair.fine.points
        lever = lever_arm_bounds(hand, points)
        moves = lever > 0
        out = kernels.Closing()
        with wp.ScopedDevice(self.model.device):
            out.direction = wp.array(hand.closing, dtype=wp.float32)
            out.moves = wp.array(moves.astype(np.int32), dtype=wp.int32)
            out.lever = wp.array(lever, dtype=wp.float32)
            out.finger = wp.array(finger_groups(moves), dtype=wp.int32)
            out.lower = wp.array(hand.lower, dtype=wp.float32)
            out.upper = wp.array(hand.upper, dtype=wp.float32)
        self.closing = out
        with wp.ScopedDevice(self.model.device):
            self.near = wp.zeros((capacity, self.hand.bodies), dtype=wp.float32)
            self.pairs = wp.zeros((capacity, self.hand.bodies, self.hand.bodies), dtype=wp.float32)
            self.stopped = wp.zeros((capacity, self.hand.dofs), dtype=wp.int32)

    def approach(self, state: HandState, standoff: float) -> HandState:
        """Move hands along their approach until the nearest body is `standoff` [m] from the object."""
        n = len(state.pivot)
        direction = np.zeros((self.capacity, 3))
        direction[:n] = quat_rotate(state.rotation, self.hand.palm.approach)
        self.data.set_state(state)
        with wp.ScopedDevice(self.model.device):
            along = wp.array(direction, dtype=wp.vec3)
        for _ in range(ADVANCES):
            self._measure()
            self._launch(kernels.advance, (), [self.near, along, standoff, SHARE], [self.data.hands])
            if not self.data.active.numpy().any():
                break
        return self.data.state(n)

    def close(self, state: HandState) -> HandState:
        """Close fingers until contact or limits; the root and dofs that do not close (spreads) do not move."""
        n, data = len(state.pivot), self.data
        data.set_state(state)
        idle = np.tile((self.hand.closing == 0).astype(np.int32) * 2, (self.capacity, 1))
        self.stopped.assign(idle)
        for _ in range(STEPS):
            self._measure(fingers=True)
            given = [self.closing, self.near, self.pairs, TOUCH_M, SHARE, LARGEST]
            self._launch(kernels.close, (), given, [data.hands, self.stopped])
            if not data.active.numpy().any():
                break
        return data.state(n)

    def _measure(self, *, fingers: bool = False) -> None:
        """Compute distances of the bodies from the object and, with `fingers`, from each other.
        Distances from the object are computed up to `REACH_M`, those from each other up to `MARGIN_M`."""
        m, d = self.model, self.data
        self._poses.run()
        self.near.fill_(REACH_M)
        self.pairs.fill_(REACH_M)
        surface = [m.obj.surface, REACH_M, m.options.exact_below]
        points = [*surface, m.point_body, m.point_position, d.hands]
        self._launch(kernels.points_to_object, (m.count,), points, [self.near])
        samples = [m.hand.pieces, m.obj.bvh.id, m.obj.samples, d.hands, MARGIN_M]
        self._launch(kernels.object_to_pieces, (m.pieces,), samples, [self.near])
        if fingers:
            bodies = [m.hand.pieces, m.body_points, d.hands, MARGIN_M]
            self._launch(kernels.bodies_to_pieces, (m.pieces,), bodies, [self.pairs])

    def _launch(self, kernel: Any, dims: tuple[int, ...], inputs: list[Any], outputs: list[Any]) -> None:
        wp.launch(kernel, (self.capacity, *dims), inputs=inputs, outputs=outputs, device=self.model.device)
