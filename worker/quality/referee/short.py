"""A short lift in coarse physics: what a planner asks of its candidates before it chooses.

The hand closes and squeezes around the object on its support in two fifths of the time of the lift test; then the
support is gone, and for a moment gravity, doubled for the jerk of a lift, pulls. Not a verdict: it ranks candidates for
a fifth of a verdict's cost, and what it chooses the lift test judges all the same.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Final

import numpy as np
from numpy.typing import NDArray

from worker.engines.mujoco_warnings import void
from worker.grasps import GraspSet
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel
from worker.quality.referee.compiled import scene_of
from worker.quality.referee.decomposition import ConvexPieces
from worker.quality.referee.lift import Lift, LiftOutcome
from worker.quality.referee.model import MujocoOptions, Scene, blend
from worker.quality.referee.protocol import LOST_ROTATION, MAX_DISPLACEMENT_M, PUSH, STAGE_S
from worker.simulation.surroundings import Placed

Floats = NDArray[np.float64]

#: The root is fixed: a hand that hangs on a spring, as the protocol has it, costs twice as much. In so short a time
#: nothing slips that would not slip without it: no iterations against slip.
PHYSICS: Final = MujocoOptions(timestep=0.006, root="fixed", noslip_iterations=0)
#: Stages of closing and of squeezing, then of hanging.
CLOSING: Final = 4
HANGING: Final = 3
#: Pull while the object hangs [N].
PULL: Final = 2.0 * PUSH
#: How far supports go away [m]: farther than any scene is high.
AWAY_M: Final = 10.0
#: Score of what is lost while closing, and of what starts too deep.
LOST: Final = 10.0
DEEP: Final = 20.0


class ShortLift(Lift):
    """Runs short lifts of grasps in one scene built with `PHYSICS`. Not for several threads at once."""

    def score(self, grasps: GraspSet, row: int) -> float:
        """Displacement or rotation over its limit when the object has hung: below 1 it would pass for lifted."""
        if self._begin(grasps, row).outcome is not LiftOutcome.NOT_TRIED:
            return DEEP
        for a, b in ((grasps.pregrasp, grasps.grasp), (grasps.grasp, grasps.squeeze)):
            for stage in range(1, CLOSING + 1):
                self.scene.command(self.data, *blend(a, b, row, stage / CLOSING))
                self._run(STAGE_S)
                moved, turned = self._motion()
                if void(self.data) or moved > MAX_DISPLACEMENT_M or turned > LOST_ROTATION:
                    return LOST
        self.data.mocap_pos[1] -= AWAY_M * self._up
        self.data.xfrc_applied[self.scene.object_body, :3] = -PULL * self._up
        self._run(HANGING * STAGE_S)
        return LOST if void(self.data) else self._excess()


class ShortLifts:
    """Short lifts of one hand and one object, for several threads at once; the scene is compiled when it is first
    needed. All scenes that are asked about have the same supports and neighbours."""

    def __init__(
        self, hand: HandModel, obj: ObjectModel, pieces: Callable[[], ConvexPieces], *, threads: int = 1
    ) -> None:
        self.hand, self.obj, self._pieces, self._threads = hand, obj, pieces, threads
        self._scene: Scene | None = None
        self._lock = threading.Lock()

    def scores(self, grasps: GraspSet, placed: Placed) -> Floats:
        """(N,) see `ShortLift.score`."""
        scene = self._compiled(placed)

        def work(rows: NDArray[np.intp]) -> list[float]:
            test = ShortLift(scene, placed)
            return [test.score(grasps, int(row)) for row in rows]

        parts = np.array_split(np.arange(len(grasps)), max(1, min(self._threads, len(grasps))))
        if len(parts) == 1:
            return np.array(work(parts[0]), float)
        with ThreadPoolExecutor(len(parts), thread_name_prefix="short-lift") as pool:
            return np.array([score for part in pool.map(work, parts) for score in part], float)

    def _compiled(self, placed: Placed) -> Scene:
        with self._lock:
            if self._scene is None:
                pieces = self._pieces()
                self._scene = scene_of(self.hand, self.obj, pieces, PHYSICS, placed.supports, placed.neighbours)
            return self._scene
