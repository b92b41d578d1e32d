"""The projection's steps against NumPy, from the very residuals that the kernels found."""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh
import warp as wp

from graspd.service.model.transforms import quat_from_axis_angle, quat_multiply
from graspd.worker.hands.kinematics import body_poses, generalized_forces
from graspd.worker.hands.surface import sample_surface
from graspd.worker.planners.fast_graspd.candidates import posture_of
from graspd.worker.simulation.data import Data, HandState, still_schedule
from graspd.worker.simulation.device import DeviceHand, DeviceObject
from graspd.worker.simulation.kernels import projection as kernels
from graspd.worker.simulation.model import LossOptions, Model
from graspd.worker.simulation.projection import Projection, ProjectionOptions
from graspd.worker.simulation.sampling import object_samples
from tests.worker.models import object_from_mesh, two_finger_hand

HAND = two_finger_hand()
BOX = object_from_mesh(trimesh.creation.box((0.06, 0.04, 0.05)))
HANDS = 6
#: Distances, rows and poses are in single precision, so steps of millimetres are good to this.
SINGLE = 2e-6


def pressing() -> HandState:
    """Hands whose fingers stand in the box, each a little more closed than the one before."""
    pivot = np.tile(HAND.palm.centre + np.array([0.001, 0, -0.095]), (HANDS, 1))
    q = np.linspace(0.3, 0.5, HANDS)[:, None] * [1.0, 0.9]
    return HandState(pivot, np.tile([1.0, 0, 0, 0], (HANDS, 1)), q)


def projection() -> Projection:
    obj = DeviceObject.create(BOX, "cpu", samples=object_samples(BOX, 500), phong_alpha=0.0, cell=0.005)
    points = sample_surface(HAND, 400)
    model = Model.create(DeviceHand.create(HAND, "cpu"), obj, points, points, LossOptions())
    return Projection(model, Data(model, HANDS), ProjectionOptions())


def evaluated(state: HandState) -> Projection:
    """Residuals and equations of a state, without a step."""
    out = projection()
    out.data.set_schedule(still_schedule())
    out.data.set_state(state)
    out._depth.fill_(np.inf)
    launches = out._validated(out._states(state), out._states(state))
    out._add_equations(launches)
    launches.run()
    return out


def equations(found: Projection, state: HandState, b: int) -> tuple[np.ndarray, np.ndarray, int]:
    """J'WJ (n, n), J'We (n,) and the number of residuals of hand b, in double precision."""
    r: Any = found.residuals
    count = int(r.count.numpy()[b])
    body, other, point, direction, value, weight = (
        getattr(r, name).numpy()[b, :count] for name in ("body", "other", "point", "direction", "value", "weight")
    )
    posture = posture_of(HAND, BOX, state[b : b + 1])
    poses = body_poses(HAND, posture.hand_pose, posture.joint_positions)[0]
    poses[:, :3] -= BOX.centre_of_mass
    rows = np.zeros((count, 6 + HAND.dofs))
    rows[:, 6:] = generalized_forces(HAND, poses, body, point, direction[:, None])[:, 0]
    both = other >= 0
    rows[both, 6:] -= generalized_forces(HAND, poses, other[both], point[both], direction[both, None])[:, 0]
    rows[~both, :3] = direction[~both]
    rows[~both, 3:6] = np.cross(point[~both] - state.pivot[b], direction[~both])
    return rows.T @ (weight[:, None] * rows), rows.T @ (weight * value), count


def test_the_equations_are_those_of_the_residuals() -> None:
    state = pressing()
    found = evaluated(state)
    for b in range(HANDS):
        matrix, vector, count = equations(found, state, b)
        assert count > 10
        np.testing.assert_allclose(
            np.tril(found.matrix.numpy()[b] / kernels.FIXED), np.tril(matrix), atol=SINGLE * count
        )
        np.testing.assert_allclose(found.vector.numpy()[b] / kernels.FIXED, vector, atol=1e-9 * count)


def test_a_step_solves_them() -> None:
    state = pressing()
    found = evaluated(state)
    moved, depth = projection().run(state, 1)
    _, before = projection().run(state, 0)
    # Of both states the less deep one is told, so the step is seen where it helped.
    assert (depth < before - 1e-4).all()
    scale = np.repeat(found.options.scale, [3, 3, HAND.dofs])
    for b in range(HANDS):
        matrix, vector, count = equations(found, state, b)
        damped = scale[:, None] * matrix * scale + found.options.damping * count * np.eye(len(scale))
        step = -np.linalg.solve(damped, scale * vector)
        step *= scale * min(1.0, found.options.step / np.linalg.norm(step))
        angle = np.linalg.norm(step[3:6])
        turned = quat_multiply(quat_from_axis_angle(step[3:6] / angle, angle), state.rotation[b])
        np.testing.assert_allclose(moved.pivot[b], state.pivot[b] + step[:3], atol=SINGLE)
        np.testing.assert_allclose(moved.rotation[b], turned, atol=SINGLE)
        q = np.clip(state.q[b] + step[6:], HAND.lower, HAND.upper)
        np.testing.assert_allclose(moved.q[b], q, atol=10 * SINGLE)


def test_the_order_of_residuals_moves_no_bit() -> None:
    state = pressing()
    found = evaluated(state)
    before = found.matrix.numpy().copy(), found.vector.numpy().copy()
    rng = np.random.default_rng(0)
    r: Any = found.residuals
    for b, count in enumerate(r.count.numpy()):
        order = rng.permutation(int(count))
        for name in ("body", "other", "point", "direction", "value", "weight"):
            array = getattr(r, name).numpy()
            array[b, :count] = array[b, order]
    for sums in (found.matrix, found.vector):
        sums.zero_()
    d, m = found.data, found.model
    wp.launch(
        kernels.normal_equations,
        (HANDS, found._lanes),
        inputs=[m.hand.tree, found._lane, d.active, d.pivot, d.body_p, d.axis, r],
        outputs=[found._row, found.matrix, found.vector],
        device="cpu",
    )
    np.testing.assert_array_equal(found.matrix.numpy(), before[0])
    np.testing.assert_array_equal(found.vector.numpy(), before[1])


def test_hands_without_penetration_stay_where_they_are() -> None:
    state = pressing()
    state.pivot[:, 2] -= 0.2
    state.q *= 0.5
    moved, depth = projection().run(state, 10)
    assert not depth.any()
    np.testing.assert_array_equal(moved.pivot, state.pivot)
    np.testing.assert_array_equal(moved.q, state.q)
