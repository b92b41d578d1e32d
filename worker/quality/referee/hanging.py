"""Lifts as the hand sees them: its root is fixed, the support goes, and the object hangs. Half the price of a rise."""

from __future__ import annotations

from typing import Final

import numpy as np

from service.model.matter import ACCELERATION
from worker.engines.mujoco_warnings import void
from worker.grasps import GraspSet
from worker.quality.referee.lift import Lift, LiftOutcome
from worker.quality.referee.short import AWAY_M

#: Stages of closing and of squeezing.
CLOSING: Final = 4
#: Pull of an object that hangs, in its weights: the mean of a smooth rise while it speeds up (`lift.SMOOTHLY`).
RISING: Final = 1.06
#: A change of the load comes over this time, in steps [s]: at once it would weigh up to twice.
LOADING_S: Final = 0.04
LOADS: Final = 5


class Hanging(Lift):
    """A scene whose root is fixed. Not for several threads at once."""

    def _closed(self, grasps: GraspSet, row: int) -> bool:
        """Whether the hand closes around the object and holds on to it."""
        if self._begin(grasps, row).outcome is not LiftOutcome.NOT_TRIED:
            return False
        return self._close(grasps, row, give_up=True, stages=CLOSING) and not void(self.data)

    def _hang(self, before: float, mass: float) -> None:
        """Let the object hang, and its weight change from that of `before` to that of `mass` [kg]."""
        self.data.mocap_pos[1] = self._scene_pose[:3] - AWAY_M * self._up
        for load in np.linspace(before, mass, LOADS + 1)[1:]:
            self.data.xfrc_applied[self.scene.object_body, :3] = -RISING * ACCELERATION * load * self._up
            self._run(LOADING_S / LOADS)
