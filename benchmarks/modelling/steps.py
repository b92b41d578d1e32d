"""Several steps of the contact simulation instead of one; the object moves, contacts are recomputed.

The step is the planner's (worker/simulation/kernels/contact.py, `direct`) in float64, for one grasp and one velocity at
a time, with distances to the mesh. The hand is fixed, as in the loss."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchmarks.integrators.reference import World, loss
from graspd.service.model.transforms import quat_from_axis_angle, quat_to_matrix
from graspd.worker.grasps import Posture
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.quality.probe import Probe
from graspd.worker.simulation.model import REFERENCE_POINTS, initial_motions

Floats = NDArray[np.float64]

PASSES = 4
VELOCITIES = 7


def forward_simulation(probe: Probe, grasp: Posture, world: World, steps: tuple[int, ...]) -> Floats:
    """Return (N, K) L_stable of N grasps after each of K numbers of steps, as means over the velocities.
    Motions are in units of the free motion of one step, for any number of steps; this does not affect ranks."""
    weight = probe.points.area * (REFERENCE_POINTS / probe.points.area.sum())
    hands = probe.posed_points(body_poses(probe.hand, grasp.hand_pose, grasp.joint_positions))
    motions = initial_motions(VELOCITIES, world.step, world.gyration)
    out = np.zeros((len(grasp), len(steps)))
    for row, points in enumerate(hands):
        ends = [_follow(probe, points - probe.obj.centre_of_mass, weight, s0, world, steps) for s0 in motions]
        out[row] = np.mean(ends, axis=0)
    return out


def _follow(
    probe: Probe, points: Floats, weight: Floats, motion: Floats, world: World, steps: tuple[int, ...]
) -> list[float]:
    """Return losses after each of `steps`; the object starts with the free motion `motion` of one step."""
    place, rotation, turned = np.zeros(3), np.eye(3), np.zeros(3)
    losses = []
    for number in range(1, max(steps) + 1):
        local = (points - place) @ rotation
        distance, _, normal = probe.signed_distance(local + probe.obj.centre_of_mass)
        near = distance < 4 * world.step
        motion = step(
            points[near] - place,
            normal[near] @ rotation.T,
            distance[near],
            weight[near],
            motion,
            world,
            rotation @ world.inertia @ rotation.T,
        )
        place, turned = place + motion[:3], turned + motion[3:]
        angle = float(np.linalg.norm(motion[3:]))
        if angle > 0:
            rotation = quat_to_matrix(quat_from_axis_angle(motion[3:] / angle, np.array(angle))) @ rotation
        if number in steps:
            losses.append(float(loss(np.concatenate([place, turned]), world)))
    return losses


def step(
    points: Floats,
    normals: Floats,
    distance: Floats,
    weight: Floats,
    s0: Floats,
    world: World,
    inertia: Floats,
    passes: int = PASSES,
) -> Floats:
    """Return the (6,) motion of the object under all contacts: compliant, with Coulomb friction."""
    mass = np.eye(6)
    mass[3:, 3:] = inertia
    rows = np.concatenate([normals, np.cross(points, normals)], axis=1)
    # (n, 3, 6): motion of the object's surface at each point.
    at = np.concatenate([np.tile(np.eye(3), (len(points), 1, 1)), -_skew(points)], axis=2)
    s = s0
    for _ in range(passes):
        u = at @ s
        along = np.einsum("ni,ni->n", normals, u)
        depth = world.dilation - distance + along
        on = depth > 0
        k = world.stiffness * weight[on]
        slip = np.linalg.norm(u[on] - along[on, None] * normals[on], axis=1)
        slide = np.minimum(k, k * world.friction * depth[on] / np.maximum(slip, 1e-9))
        j, t = rows[on], at[on]
        a = mass + (j * (k - slide)[:, None]).T @ j + np.einsum("n,nij,nik->jk", slide, t, t, optimize=True)
        s = np.linalg.solve(a, mass @ s0 - j.T @ (k * (world.dilation - distance[on])))
    return s


def _skew(points: Floats) -> Floats:
    out = np.zeros((len(points), 3, 3))
    x, y, z = points.T
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -z, y, -x
    out[:, 1, 0], out[:, 2, 0], out[:, 2, 1] = z, -y, x
    return out
