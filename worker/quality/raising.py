"""Pregrasps raised where fingers that open sideways would dip into what the object stands on.

A finger that stands on the table swings through it when it opens: its hand comes from a little higher.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from worker.grasps import Posture
from worker.hands.model import HandModel
from worker.simulation.obstacles import obstacle_room
from worker.simulation.surroundings import CLEAR_M, Placed

Floats = NDArray[np.float64]

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
    for number, scene in enumerate(placed.scenes):
        rows = np.flatnonzero(placed.index == number)
        if not len(rows) or all(one.tips_m is None for one in scene.obstacles):
            continue
        lack = np.stack([_lack(hand, grasp.take(rows), pregrasp.take(rows), placed, number, t) for t in LOOKS])
        # What the root is raised by at first is less and less on the way.
        height = (lack / (1 - np.array(LOOKS))[:, None]).max(axis=0)
        height = np.where(height <= HIGHEST_M, height, 0.0)
        poses[rows, :3] += height[:, None] * scene.up
    return Posture(poses, pregrasp.joint_positions)


def _lack(hand: HandModel, grasp: Posture, pregrasp: Posture, placed: Placed, scene: int, share: float) -> Floats:
    """(n,) what hands lack of their room at a share of their way."""
    pose = (1 - share) * pregrasp.hand_pose + share * grasp.hand_pose
    pose[:, 3:] = pregrasp.hand_pose[:, 3:]  # a pregrasp is never turned against its grasp
    joints = (1 - share) * pregrasp.joint_positions + share * grasp.joint_positions
    room = obstacle_room(hand, Posture(pose, joints), placed.scenes[scene])
    return np.maximum(0.0, (CLOSING_M if share else OPEN_M) - room)
