"""The commanded posture that makes a gripper press: its jaws go on to where they touch, then by force over gain."""

from __future__ import annotations

from typing import Final

import numpy as np

from graspd.service.model.transforms import Floats, apply
from graspd.worker.grasps import Posture
from graspd.worker.hands.jaws import Jaws
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.quality.probe import Probe

#: A pad that is farther from the object than this is not waited for [m].
GAP_M: Final = 0.005
#: A drive that is to press with its limit is told to go so many times the way that needs.
STALL: Final = 2.0
#: A dof moves a pad if it does so by this [m/rad or 1].
LEAST_WAY: Final = 1e-4


def jaw_squeeze(probe: Probe, jaws: Jaws, grasp: Posture, *, total_normal_force: float) -> Posture:
    """N commanded postures of a gripper, within its stroke; the root unchanged.

    Each pad is to press with half of `total_normal_force` [N], or with what the limits of the dofs leave: a dof that
    moves both pads shares its limit between them. A gripper told to go beyond its stroke reports an error instead of
    pressing, so what lies there is cut off.
    """
    hand = probe.hand
    q = hand.reduce(np.asarray(grasp.joint_positions, float))
    gaps = np.maximum(_gaps(probe, jaws, grasp), 0.0)
    speed = np.abs(jaws.speeds(q))
    ways = np.maximum(speed.sum(axis=2), 1e-9)
    # Both pads press alike, or they would push the object away: the weaker one tells how hard.
    able = np.where(ways > LEAST_WAY, hand.effort / ways, np.inf).min(axis=1)
    force = np.where((gaps < GAP_M).all(axis=1), np.minimum(0.5 * total_normal_force, able), 0.0)
    # One drive at its limit holds both pads by their coupling: told to go farther it still presses with its limit, and
    # loses nothing to contacts that give way. Two drives at their limits would give way to any push.
    stalls = (np.count_nonzero(hand.closing) == 1) & (able < 0.5 * total_normal_force)
    press = np.where(stalls, STALL, 1.0) * force
    travel = np.where(speed > LEAST_WAY, np.minimum(gaps, GAP_M)[:, None], 0.0).sum(axis=2) / ways
    step = np.where(force > 0, 1.0, 0.0)[:, None] * travel + press[:, None] * ways / hand.stiffness
    q = q + hand.closing * np.where(ways > LEAST_WAY, step, 0.0)
    return Posture(np.array(grasp.hand_pose, float), hand.expand(np.clip(q, hand.lower, hand.upper)))


def _gaps(probe: Probe, jaws: Jaws, grasp: Posture) -> Floats:
    """(N, 2) least distance of each pad to the object [m]."""
    bodies = body_poses(probe.hand, grasp.hand_pose, grasp.joint_positions)
    points = apply(bodies[:, jaws.points.body], jaws.points.position)
    distance = probe.signed_distance(points.reshape(-1, 3))[0].reshape(points.shape[:2])
    first = jaws.first
    return np.stack([distance[:, first].min(axis=1), distance[:, ~first].min(axis=1)], axis=1)
