"""A short lift in coarse physics: what a planner asks of its candidates before it chooses.

The hand closes and squeezes around the object on its support in two fifths of the time of the lift test; then the
support is gone, and for a moment gravity, doubled for the jerk of a lift, pulls. All this at half the friction: what
slips then hangs once more, from the same closed hand, at the whole friction. Not a verdict: it ranks candidates for a
fifth of a verdict's cost, and what it chooses the lift test judges all the same.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Final, TypeVar

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
_T = TypeVar("_T")

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
#: Added to the score of what holds at the whole friction only.
SLIPS: Final = 1.0
#: Score of what is lost while closing, and of what starts too deep.
LOST: Final = 10.0
DEEP: Final = 20.0


@dataclass(frozen=True)
class Frictions:
    """The scene built with `PHYSICS`, at half the friction and at the whole of it; all else is the same."""

    half: Scene
    whole: Scene


class ShortLift(Lift):
    """Runs short lifts of grasps in one scene. Not for several threads at once."""

    def __init__(self, scenes: Frictions, placed: Placed) -> None:
        super().__init__(scenes.half, placed)
        self._scenes = scenes

    def score(self, grasps: GraspSet, row: int) -> float:
        """Displacement or rotation over its limit when the object has hung at half the friction: below 1 it would pass
        for lifted. Else that at the whole friction, and `SLIPS`."""
        self.scene = self._scenes.half
        if self._begin(grasps, row).outcome is not LiftOutcome.NOT_TRIED:
            return DEEP
        for a, b in ((grasps.pregrasp, grasps.grasp), (grasps.grasp, grasps.squeeze)):
            for stage in range(1, CLOSING + 1):
                self.scene.command(self.data, *blend(a, b, row, stage / CLOSING))
                self._run(STAGE_S)
                moved, turned = self._motion()
                if void(self.data) or moved > MAX_DISPLACEMENT_M or turned > LOST_ROTATION:
                    return LOST
        self._save()
        hung = self._hung(enough=1.0)
        if hung < 1.0:
            return hung
        self.scene = self._scenes.whole
        self._restore()
        return SLIPS + self._hung()

    def _hung(self, enough: float = np.inf) -> float:
        """Displacement or rotation over its limit when the support has gone; that is all if it is `enough` before."""
        self.data.mocap_pos[1] = self._scene_pose[:3] - AWAY_M * self._up
        self.data.xfrc_applied[self.scene.object_body, :3] = -PULL * self._up
        for _ in range(HANGING):
            self._run(STAGE_S)
            excess = LOST if void(self.data) else self._excess()
            if excess >= enough:
                break
        return excess

    def comes(self, grasps: GraspSet, row: int) -> bool:
        """Whether the open hand reaches its pregrasp as the lift test asks; `grasps.approach` says how it comes."""
        self._begin(grasps, row)
        return not self._touches(grasps, row)


class ShortLifts:
    """Short lifts of one hand and one object, for several threads at once; the scene is compiled when it is first
    needed. All scenes that are asked about have the same supports and neighbours."""

    def __init__(
        self, hand: HandModel, obj: ObjectModel, pieces: Callable[[], ConvexPieces], *, threads: int = 1
    ) -> None:
        self.hand, self.obj, self._pieces, self._threads = hand, obj, pieces, threads
        self._scenes: Frictions | None = None
        self._lock = threading.Lock()

    def scores(self, grasps: GraspSet, placed: Placed) -> Floats:
        """(N,) see `ShortLift.score`."""
        return np.array(self._each(ShortLift.score, grasps, placed), float)

    def come(self, grasps: GraspSet, placed: Placed) -> NDArray[np.bool_]:
        """(N,) see `ShortLift.comes`."""
        return np.array(self._each(ShortLift.comes, grasps, placed), bool)

    def _each(self, ask: Callable[[ShortLift, GraspSet, int], _T], grasps: GraspSet, placed: Placed) -> list[_T]:
        scenes = self._compiled(placed)

        def work(rows: NDArray[np.intp]) -> list[_T]:
            test = ShortLift(scenes, placed)
            return [ask(test, grasps, int(row)) for row in rows]

        parts = np.array_split(np.arange(len(grasps)), max(1, min(self._threads, len(grasps))))
        if len(parts) == 1:
            return work(parts[0])
        with ThreadPoolExecutor(len(parts), thread_name_prefix="short-lift") as pool:
            return [answer for part in pool.map(work, parts) for answer in part]

    def _compiled(self, placed: Placed) -> Frictions:
        with self._lock:
            if self._scenes is None:
                pieces = self._pieces()
                self._scenes = Frictions(
                    *(
                        scene_of(self.hand, self.obj, pieces, physics, placed.supports, placed.neighbours)
                        for physics in (PHYSICS.hardened(), PHYSICS)
                    )
                )
            return self._scenes
