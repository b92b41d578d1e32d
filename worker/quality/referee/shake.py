"""The shake: what was lifted is moved to and fro, first along x of the scene, then along y.

The hand stands still and the object feels the inertial force of the motion. Accelerations begin at zero: the velocity
that this leaves the hand with is the same as none (Galilei).
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from service.model.matter import ACCELERATION
from service.model.transforms import Floats, quat_rotate
from worker.engines.mujoco_warnings import void
from worker.grasps import GraspSet
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel
from worker.quality.referee.compiled import scene_of
from worker.quality.referee.decomposition import ConvexPieces
from worker.quality.referee.hanging import Hanging
from worker.quality.referee.protocol import LOST
from worker.quality.referee.short import LIFTING
from worker.quality.referee.threads import measured
from worker.run import ALONE, Run
from worker.simulation.surroundings import Placed

#: Amplitude [m], frequency [Hz] and periods along each axis: at most 7.1 m/s2.
AMPLITUDE_M: Final = 0.02
FREQUENCY_HZ: Final = 3.0
PERIODS: Final = 3
#: The force changes in steps of this length [s].
STEP_S: Final = 0.008


class Shake(Hanging):
    """Shakes grasps in one scene. Not for several threads at once."""

    def margin(self, grasps: GraspSet, row: int) -> float:
        """Worst displacement or rotation of the object in the hand over its limit, until it is lost: 1 or more."""
        if not self._closed(grasps, row):
            return LOST
        self._hang(0.0, self.scene.mass)
        turn = 2 * math.pi * FREQUENCY_HZ
        worst = 0.0
        for axis in np.eye(3)[:2]:
            along = quat_rotate(self._scene_pose[3:], axis)
            for step in range(round(PERIODS / FREQUENCY_HZ / STEP_S)):
                jerked = AMPLITUDE_M * turn**2 * math.sin(turn * step * STEP_S) * along
                force = -self.scene.mass * (ACCELERATION * self._up + jerked)
                self.data.xfrc_applied[self.scene.object_body, :3] = force
                self._run(STEP_S)
                worst = max(worst, LOST if void(self.data) else self._excess())
                if worst >= 1.0:
                    return worst
        return worst


def shake_margins(
    hand: HandModel,
    obj: ObjectModel,
    grasps: GraspSet,
    placed: Placed,
    *,
    pieces: ConvexPieces,
    held: NDArray[np.bool_] | None = None,
    run: Run = ALONE,
) -> Floats:
    """(N,) worst displacement or rotation over its limit of each grasp that is shaken: below 1 it survives; nan: not
    tried.

    Args:
        hand: the hand.
        obj: the object.
        grasps: N grasps.
        placed: their scenes.
        pieces: the object's convex pieces.
        held: (N,) which grasps are tried; None: all.
        run: asked between grasps whether to stop.

    Raises:
        TaskCancelled: when `run.cancelled()` answers True.
    """

    def make() -> Shake:
        return Shake(scene_of(hand, obj, pieces, LIFTING, placed.supports, placed.neighbours), placed)

    return measured(len(grasps), held, make, lambda test, row: test.margin(grasps, row), run=run, name="shake")
