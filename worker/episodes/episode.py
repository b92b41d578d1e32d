"""Episodes: motions of an arm with a hand, or of a flying hand, executed with one grasp each."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.transforms import IDENTITY_POSE, Floats
from graspd.worker.episodes.reach import Arm
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.model import HandModel

#: Phases of an episode in order; `phase` of an episode has their numbers.
PHASES: Final = ("transit", "approach", "shape", "close", "squeeze", "lift", "hold")
#: Names of the root pose in the state of a flying hand.
ROOT_POSE: Final = ("hand_x", "hand_y", "hand_z", "hand_qw", "hand_qx", "hand_qy", "hand_qz")


class EpisodeOutcome(IntEnum):
    """Outcome of an episode. Codes above `DIVERGED` are reasons why a grasp was not executed."""

    SUCCEEDED = 0
    TOUCHED = 1  # the object was moved before the hand closed, or a neighbour at any time
    NOT_LIFTED = 2
    DROPPED = 3  # after a rise, or displaced or rotated in the hand beyond the limits of the lift test
    DIVERGED = 4
    OUT_OF_REACH = 5
    NO_CONTINUOUS_MOTION = 6
    COLLISION = 7
    NO_TRANSIT = 8


@dataclass(frozen=True)
class Robot:
    """A hand that an arm carries, or that flies."""

    hand: HandModel
    arm: Arm | None = None
    base: Floats = field(default_factory=IDENTITY_POSE.copy)  # (7,) pose of the arm's root link in the scene

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the D values of a state: the arm's dofs or the root pose, then the hand's dofs."""
        return (*(ROOT_POSE if self.arm is None else self.arm.model.dof_names), *self.hand.dof_names)

    def poses(self, state: Floats) -> list[tuple[HandModel, Floats]]:
        """Return the hand, and the arm if there is one, with their body poses (T, L, 7) in T states (T, D)."""
        state = np.atleast_2d(np.asarray(state, float))
        split = len(self.names) - self.hand.dofs
        carrier, dofs = state[:, :split], state[:, split:]
        if self.arm is None:
            return [(self.hand, body_poses(self.hand, carrier, self.hand.expand(dofs)))]
        base = np.broadcast_to(self.base, (len(state), 7))
        of_arm = body_poses(self.arm.model, base, self.arm.model.expand(carrier))
        root = self.arm.root_pose(of_arm[:, self.arm.mount_body])
        return [(self.hand, body_poses(self.hand, root, self.hand.expand(dofs))), (self.arm.model, of_arm)]


@dataclass(frozen=True)
class Episode:
    """One executed grasp, T frames at equal times; without frames if it was not executed.
    Numbers have the precision of float32, as in files."""

    row: int  # row of the grasp in its shard
    scene: int
    outcome: EpisodeOutcome
    phase: NDArray[np.uint8]  # (T,) indices of `PHASES`
    state: Floats  # (T, D) measured, in the order of `Robot.names` [m, 1, rad]
    action: Floats  # (T, D) commanded from this frame to the next
    object_pose: Floats = field(default_factory=lambda: np.zeros((0, 7)))  # (T, 7) in the scene
    neighbour_pose: Floats = field(default_factory=lambda: np.zeros((0, 0, 7)))  # (T, M, 7) in the scene
    videos: Mapping[str, bytes] = field(default_factory=dict)  # video of each of `columns.VIDEOS`
    camera_pose: Mapping[str, Floats] = field(default_factory=dict)
    """(T, 7) pose of each camera in the scene: x right, y down, z forward."""
