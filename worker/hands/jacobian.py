"""Transpose of the hand's Jacobian: from forces at points of bodies to torques of the degrees of freedom."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from service.model.transforms import Floats, cross, quat_rotate
from worker.hands.model import HandModel, JointType


def ancestors(hand: HandModel) -> NDArray[np.bool_]:
    """(L, L): [a, b] whether the joint of body b moves body a (b itself included, the root not)."""
    moves = np.zeros((hand.bodies, hand.bodies), dtype=bool)
    for body in range(1, hand.bodies):
        moves[body] = moves[hand.parent[body]]
        moves[body, body] = True
    return moves


def generalized_forces(
    hand: HandModel, bodies: Floats, body: NDArray[np.integer], points: Floats, forces: Floats
) -> Floats:
    """Generalized forces that forces on the hand exert on its dofs, mimicking joints folded in.

    By virtual work: the torque on a dof is the sum over the joints it drives of multiplier times joint torque.

    Args:
        hand: the hand.
        bodies: (..., L, 7) body poses.
        body: (..., C) the body that each point belongs to.
        points: (..., C, 3) points in the frame of the poses [m].
        forces: (..., C, E, 3) E forces at each point [N].

    Returns:
        (..., C, E, D) [N m, or N for prismatic dofs].
    """
    axis = quat_rotate(bodies[..., 3:], hand.axis)[..., None, :, :]
    lever = np.asarray(points, float)[..., :, None, :] - bodies[..., None, :, :3]
    # axis . (lever x force) = force . (axis x lever)
    motion = np.where((hand.joint_type == JointType.REVOLUTE)[:, None], cross(axis, lever), axis)
    motion = np.where(ancestors(hand)[body][..., None], motion, 0.0)
    joint = np.asarray(forces, float) @ np.swapaxes(motion, -1, -2)
    drive = np.zeros((hand.bodies, hand.dofs))
    moving = np.arange(1, hand.bodies)
    drive[moving, hand.dof[moving]] = hand.multiplier[moving]
    torque: Floats = joint @ drive
    return torque
