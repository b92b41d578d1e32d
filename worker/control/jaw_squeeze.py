"""Squeeze posture of a gripper: its jaws close to contact, then further by force / position gain."""

from typing import Final

import numpy as np

from graspd.service.model.transforms import Floats, apply
from graspd.worker.grasps import Posture
from graspd.worker.hands.jaws import Jaws
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.quality.probe import Probe

#: A pad farther from the object than this does not close [m].
GAP_M: Final = 0.005
#: Commanded travel of a drive whose limit sets the force, as a multiple of the required travel.
STALL: Final = 2.0
#: Least speed of a pad for a dof to count as moving it [m/rad or 1].
LEAST_WAY: Final = 1e-4


def jaw_squeeze(probe: Probe, jaws: Jaws, grasp: Posture, *, total_normal_force: float) -> Posture:
    """Compute N commanded postures of a gripper, within its stroke; the root is unchanged.
    The pads press with `total_normal_force` [N] together, with less if effort limits require it. A dof that moves both
    pads divides its limit between them. Commands stay within the stroke: a gripper commanded beyond it reports an
    error."""
    hand = probe.hand
    q = hand.reduce(np.asarray(grasp.joint_positions, float))
    gaps = np.maximum(_gaps(probe, jaws, grasp), 0.0)
    speed = np.abs(jaws.speeds(q))
    ways = np.maximum(speed.sum(axis=2), 1e-9)
    # Unequal forces would push the object away. The weaker pad therefore sets the force of both pads.
    able = np.where(ways > LEAST_WAY, hand.effort / ways, np.inf).min(axis=1)
    force = np.where((gaps < GAP_M).all(axis=1), np.minimum(0.5 * total_normal_force, able), 0.0)
    # A single drive at its limit holds both pads by their coupling. A command beyond the required travel adds no force,
    # but prevents a loss of force in compliant contacts. Two drives at their limits would yield to any push.
    stalls = (np.count_nonzero(hand.closing) == 1) & (able < 0.5 * total_normal_force)
    press = np.where(stalls, STALL, 1.0) * force
    travel = np.where(speed > LEAST_WAY, np.minimum(gaps, GAP_M)[:, None], 0.0).sum(axis=2) / ways
    step = np.where(force > 0, 1.0, 0.0)[:, None] * travel + press[:, None] * ways / hand.stiffness
    q = q + hand.closing * np.where(ways > LEAST_WAY, step, 0.0)
    return Posture(np.array(grasp.hand_pose, float), hand.expand(np.clip(q, hand.lower, hand.upper)))


def _gaps(probe: Probe, jaws: Jaws, grasp: Posture) -> Floats:
    """Return the least distance (N, 2) of each pad from the object [m]."""
    bodies = body_poses(probe.hand, grasp.hand_pose, grasp.joint_positions)
    points = apply(bodies[:, jaws.points.body], jaws.points.position)
    distance = probe.signed_distance(points.reshape(-1, 3))[0].reshape(points.shape[:2])
    first = jaws.first
    return np.stack([distance[:, first].min(axis=1), distance[:, ~first].min(axis=1)], axis=1)
