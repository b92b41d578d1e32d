"""Pregrasps raised where fingers that open sideways would dip into what the object stands on.

A finger that stands on the table swings through it when it opens: its hand comes from a little higher.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from service.model.transforms import Floats
from worker.grasps import Posture
from worker.hands.model import HandModel
from worker.simulation.obstacles import obstacle_room
from worker.simulation.surroundings import CLEAR_M, Placed

#: Room that the open hand has, and that it has while it closes [m]: a little more than is asked for, since ways are
#: looked at in steps.
OPEN_M: Final = CLEAR_M + 0.0025
CLOSING_M: Final = CLEAR_M + 0.0003
#: Shares of the way to the grasp that are looked at: those of the sweep, but for the grasp itself.
LOOKS: Final = tuple(np.arange(8) / 8)
#: A hand is raised by no more than this [m]: from higher it would come down on the object.
HIGHEST_M: Final = 0.008


def raised(hand: HandModel, grasp: Posture, pregrasp: Posture, placed: Placed) -> Posture:
    """Pregrasps (N) whose root went against gravity by what the hand lacks of its room on the straight way from there
    to the grasp; those that lack nothing, or too much, are as they were."""
    poses = np.array(pregrasp.hand_pose, float)
    near = np.array([any(one.tips_m is not None for one in scene.obstacles) for scene in placed.scenes], bool)
    rows = np.flatnonzero(near[placed.index])
    if not len(rows):
        return pregrasp
    lack = _lack(hand, grasp.take(rows), pregrasp.take(rows), placed.take(rows))
    # What the root is raised by at first is less and less on the way.
    height = (lack / (1 - np.array(LOOKS))).max(axis=1)
    height = np.where(height <= HIGHEST_M, height, 0.0)
    up = np.array([scene.up for scene in placed.scenes])[placed.index[rows]]
    poses[rows, :3] += height[:, None] * up
    return Posture(poses, pregrasp.joint_positions)


def _lack(hand: HandModel, grasp: Posture, pregrasp: Posture, placed: Placed) -> Floats:
    """(n, looks) what hands lack of their room at the shares `LOOKS` of their way."""
    share = np.array(LOOKS)[None, :, None]
    pose = (1 - share) * pregrasp.hand_pose[:, None] + share * grasp.hand_pose[:, None]
    pose[..., 3:] = pregrasp.hand_pose[:, None, 3:]  # a pregrasp is never turned against its grasp
    joints = (1 - share) * pregrasp.joint_positions[:, None] + share * grasp.joint_positions[:, None]
    postures = Posture(pose.reshape(-1, 7), joints.reshape(-1, joints.shape[-1]))
    room = obstacle_room(hand, postures, placed.scenes, np.repeat(placed.index, len(LOOKS)))
    wanted = np.where(np.array(LOOKS) > 0, CLOSING_M, OPEN_M)
    return np.maximum(0.0, wanted - room.reshape(len(grasp), -1))
