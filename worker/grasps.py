"""A set of grasps of one hand on one object: what planners make and what quality, scenes and shards read."""

from __future__ import annotations

from collections.abc import Sequence
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

    def take(self, rows: NDArray[np.intp] | slice) -> Posture:
        """Some of the postures, in the order of `rows`."""
        return Posture(np.asarray(self.hand_pose, float)[rows], np.asarray(self.joint_positions, float)[rows])


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

    def take(self, rows: NDArray[np.intp] | slice) -> GraspSet:
        """Some of the grasps, in the order of `rows`; what the planner said of the whole set stays."""
        loss = np.asarray(self.stability_loss, float)[rows]
        grasp, pregrasp, squeeze = (part.take(rows) for part in (self.grasp, self.pregrasp, self.squeeze))
        return GraspSet(grasp, pregrasp, squeeze, loss, self.seconds, self.info)


def joined(sets: Sequence[GraspSet]) -> GraspSet:
    """Several sets of one hand on one object as one; of the planner's remarks, those on the first set."""
    grasp, pregrasp, squeeze = (
        _joined([getattr(part, name) for part in sets]) for name in ("grasp", "pregrasp", "squeeze")
    )
    loss = np.concatenate([np.asarray(part.stability_loss, float) for part in sets])
    return GraspSet(grasp, pregrasp, squeeze, loss, sum(part.seconds for part in sets), dict(sets[0].info))


def _joined(parts: Sequence[Posture]) -> Posture:
    return Posture(
        np.concatenate([part.hand_pose for part in parts]), np.concatenate([part.joint_positions for part in parts])
    )
