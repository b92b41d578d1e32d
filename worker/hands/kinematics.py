"""Forward kinematics in float64 NumPy: the reference the kernels are tested against, and what slow paths use."""

from __future__ import annotations

import numpy as np

from service.model.transforms import compose, quat_from_axis_angle
from worker.hands.model import Floats, HandModel, JointType


def body_poses(hand: HandModel, hand_pose: Floats, joint_positions: Floats) -> Floats:
    """Poses of all bodies.

    Args:
        hand: the hand.
        hand_pose: (N, 7) pose of the root link in the world (here: the object) frame.
        joint_positions: (N, J) in `HandModel.joint_names` order [rad or m].

    Returns:
        (N, L, 7) pose of each body's frame in the world frame.
    """
    hand_pose = np.atleast_2d(np.asarray(hand_pose, float))
    joints = np.atleast_2d(np.asarray(joint_positions, float))
    poses = np.empty((len(hand_pose), hand.bodies, 7))
    poses[:, 0] = hand_pose
    joint_of_body = {int(body): j for j, body in enumerate(hand.joint_body)}
    for body in range(1, hand.bodies):
        value = joints[:, joint_of_body[body]]
        motion = np.zeros((len(joints), 7))
        motion[:, 3] = 1.0
        if hand.joint_type[body] == JointType.REVOLUTE:
            motion[:, 3:] = quat_from_axis_angle(hand.axis[body], value)
        else:
            motion[:, :3] = value[:, None] * hand.axis[body]
        poses[:, body] = compose(compose(poses[:, hand.parent[body]], hand.origin[body]), motion)
    return poses
