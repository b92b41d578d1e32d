"""A set of grasps of one hand on one object: what planners make and what quality, scenes and shards read."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass
class Posture:
    """N hand postures in the object frame."""

    hand_pose: Floats
    """(N, 7) pose of the hand's root link in the object frame: x y z, then quaternion w x y z."""
    joint_positions: Floats
    """(N, J) all moving joints in `HandModel.joint_names` order [rad or m]."""

    def __len__(self) -> int:
        return len(self.hand_pose)


@dataclass
class GraspSet:
    """N grasps with the postures before and after contact and the planner's own loss."""

    grasp: Posture
    pregrasp: Posture
    squeeze: Posture
    stability_loss: Floats
    """(N,) L_stable of the planner; nan where the planner has none."""
    seconds: float = 0.0
    info: dict[str, object] = field(default_factory=dict)
    """What the planner wants kept: loss curves, iteration counts. JSON values only."""

    def __len__(self) -> int:
        return len(self.grasp)
