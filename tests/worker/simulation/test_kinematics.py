"""Kernel kinematics against float64 NumPy; the transpose against finite differences."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import warp as wp

from graspd.service.model.transforms import apply, quat_from_axis_angle, quat_multiply, quat_rotate
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.simulation.data import HandState
from graspd.worker.simulation.kernels import kinematics, wrenches
from graspd.worker.simulation.record import record_placement
from tests.worker.simulation.rigs import ball, rig

FK_TOLERANCE = 3e-7  # float32 positions of a hand 0.2 m large through at most 8 joints


def random_state(hand: HandModel, count: int, seed: int = 0) -> HandState:
    rng = np.random.default_rng(seed)
    rotation = rng.normal(size=(count, 4))
    rotation /= np.linalg.norm(rotation, axis=1, keepdims=True)
    q = hand.lower + rng.random((count, hand.dofs)) * (hand.upper - hand.lower)
    return HandState(0.05 * rng.normal(size=(count, 3)), rotation, q)


def root_poses(hand: HandModel, state: HandState) -> np.ndarray:
    return np.concatenate([state.pivot - quat_rotate(state.rotation, hand.palm.centre), state.rotation], axis=1)


def moved(state: HandState, column: int, step: float) -> HandState:
    pivot, rotation, q = state.pivot.copy(), state.rotation.copy(), state.q.copy()
    if column < 3:
        pivot[0, column] += step
    elif column < 6:
        rotation[0] = quat_multiply(quat_from_axis_angle(np.eye(3)[column - 3], np.array(step)), rotation[0])
    else:
        q[0, column - 6] += step
    return HandState(pivot, rotation, q)


def differences(energy: Callable[[HandState], float], state: HandState, columns: int, step: float) -> np.ndarray:
    """Central differences by the columns of a gradient: root translation, root rotation, dofs."""
    ends = [[energy(moved(state, c, s)) for s in (step, -step)] for c in range(columns)]
    return np.array([(high - low) / (2 * step) for high, low in ends])


@pytest.mark.parametrize("name", ["allegro", "barrett", "shadow"])
def test_the_kernel_places_bodies_where_float64_kinematics_does(name: str) -> None:
    hand = hand_from_path(name)
    state = random_state(hand, 6)
    model, data = rig(hand, ball(), capacity=6)
    data.set_state(state)
    record_placement(model, data).run()
    expected = body_poses(hand, root_poses(hand, state), hand.expand(state.q))
    np.testing.assert_allclose(data.body_p.numpy(), expected[..., :3], atol=FK_TOLERANCE)


@pytest.mark.parametrize("name", ["allegro", "barrett", "shadow"])
def test_transpose_is_the_derivative_of_the_map_it_belongs_to(name: str) -> None:
    """Random forces at random points: their work by the transpose equals central differences in float64."""
    hand = hand_from_path(name)
    rng = np.random.default_rng(3)
    state = random_state(hand, 1, seed=3)
    local = 0.02 * rng.normal(size=(hand.bodies, 3))
    force = rng.normal(size=(hand.bodies, 3))

    def work(at: HandState) -> float:
        poses = body_poses(hand, root_poses(hand, at), hand.expand(at.q))[0]
        return float((apply(poses, local) * force).sum())

    expected = differences(work, state, 6 + hand.dofs, step=1e-6)
    model, data = rig(hand, ball(), capacity=1)
    data.set_state(state)
    record_placement(model, data).run()
    poses = body_poses(hand, root_poses(hand, state), hand.expand(state.q))[0]
    points = apply(poses, local)
    wrench = np.concatenate([force, np.cross(points, force)], axis=1)
    data.wrench.assign(np.round(wrench[None] / wrenches.UNIT).astype(np.int64))
    wp.launch(kinematics.backward, 1, inputs=[model.hand.tree], outputs=[data.hands, data.gradient], device="cpu")
    # Sums of up to 23 float32 products of size 1.
    np.testing.assert_allclose(data.gradient.numpy()[0], expected, atol=2e-5)
