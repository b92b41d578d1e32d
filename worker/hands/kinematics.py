"""Forward kinematics and transposed Jacobian of a hand in float64 NumPy: reference of the kernels."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.transforms import Floats, compose, cross, quat_from_axis_angle, quat_rotate
from graspd.worker.hands.model import HandModel, JointType


def body_poses(hand: HandModel, hand_pose: Floats, joint_positions: Floats) -> Floats:
    """Compute the poses (N, L, 7) of all bodies in the frame of `hand_pose` (N, 7), the root link's poses.
    `joint_positions` (N, J) [rad or m] are in the order of `HandModel.joint_names`."""
    hand_pose = np.atleast_2d(np.asarray(hand_pose, float))
    joints = np.atleast_2d(np.asarray(joint_positions, float))
    poses = np.empty((len(hand_pose), hand.bodies, 7))
    poses[:, 0] = hand_pose
    joint_of_body = np.full(hand.bodies, -1)
    joint_of_body[hand.joint_body] = np.arange(len(hand.joint_body))
    for level in _bodies_by_depth(hand.parent.tobytes()):
        value, axis = joints[:, joint_of_body[level]], hand.axis[level]
        turns = (hand.joint_type[level] == JointType.REVOLUTE)[:, None]
        rotation = np.where(turns, quat_from_axis_angle(axis, value), [1.0, 0, 0, 0])
        motion = np.concatenate([np.where(turns, 0.0, value[..., None] * axis), rotation], axis=-1)
        poses[:, level] = compose(compose(poses[:, hand.parent[level]], hand.origin[level]), motion)
    return poses


@lru_cache(maxsize=64)
def _bodies_by_depth(parents: bytes) -> tuple[NDArray[np.intp], ...]:
    """Group bodies by their distance from the root, in ascending order and without the root."""
    parent = np.frombuffer(parents, np.int32)
    depth = np.zeros(len(parent), int)
    for body in range(1, len(parent)):
        depth[body] = depth[parent[body]] + 1
    return tuple(np.flatnonzero(depth == level) for level in range(1, depth.max() + 1))


def ancestors(hand: HandModel) -> NDArray[np.bool_]:
    """Return a mask (L, L): [a, b] is True if body b has a joint that moves body a, also for a = b."""
    moves = np.zeros((hand.bodies, hand.bodies), dtype=bool)
    for body in range(1, hand.bodies):
        moves[body] = moves[hand.parent[body]]
        moves[body, body] = True
    return moves


def generalized_forces(
    hand: HandModel, bodies: Floats, body: NDArray[np.integer], points: Floats, forces: Floats
) -> Floats:
    """Compute generalized forces (..., C, E, D) on dofs [N m or N] from forces on bodies.
    By virtual work the torque on a dof is the sum over its joints of multiplier times joint torque. `bodies` (..., L,
    7) are poses; `body` (..., C) is the body of each point. `points` (..., C, 3) [m] are in the frame of the poses; E
    `forces` (..., C, E, 3) act at each point [N]."""
    axis = quat_rotate(bodies[..., 3:], hand.axis)[..., None, :, :]
    lever = np.asarray(points, float)[..., :, None, :] - bodies[..., None, :, :3]
    # axis . (lever x force) = force . (axis x lever)
    motion = np.where((hand.joint_type == JointType.REVOLUTE)[:, None], cross(axis, lever), axis)
    motion = np.where(ancestors(hand)[body][..., None], motion, 0.0)
    joint = np.asarray(forces, float) @ np.swapaxes(motion, -1, -2)
    drive = np.zeros((hand.bodies, hand.dofs))
    drive[np.arange(1, hand.bodies), hand.dof[1:]] = hand.multiplier[1:]
    return np.asarray(joint @ drive)
