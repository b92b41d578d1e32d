"""Short tests in coarse physics: rollouts that rank a planner's candidates.

The hand closes and squeezes around the object in a fraction of the time of the whole test. In a scene the support is
then gone, and for a moment most of the object's weight pulls; a free object is pushed towards the corners of a
tetrahedron, nearly twice as hard as it weighs. All this at half the friction: what slips is pulled once more, from the
same closed hand, at the whole friction, and by a third more than the weight in a scene. Not a verdict: it ranks
candidates for a fifth of a verdict's cost, and what it chooses the whole test validates all the same.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.matter import ACCELERATION
from graspd.service.model.transforms import Floats
from graspd.worker.engines.mujoco_warnings import void
from graspd.worker.grasps import GraspSet
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.simulation.environment import PlacedGrasps
from graspd.worker.validation.compiled import scene_of
from graspd.worker.validation.decomposition import ConvexPieces
from graspd.worker.validation.lift import Lift, LiftOutcome
from graspd.worker.validation.model import MujocoOptions, Scene
from graspd.worker.validation.protocol import LOST, STAGE_S, Outcome, Test

_T = TypeVar("_T")

#: The root is fixed: a hand that hangs on a spring, as the protocol has it, costs twice as much. In so short a time
#: nothing slips that would not slip without it: no iterations against slip.
PHYSICS: Final = MujocoOptions(timestep=0.006, root="fixed", noslip_iterations=0)
#: The same of a lift: under the weight of a real object coarser contacts creep.
LIFTING: Final = MujocoOptions(root="fixed")
#: Stages of closing and of squeezing, then of hanging.
CLOSING: Final = 2
HANGING: Final = 6
#: The same of a free object, and of a push.
FREE_CLOSING: Final = 3
PUSHED: Final = 2
#: Pull while the object hangs at half the friction, at the whole of it, and of a push, in its weights. A hand that is
#: turned away costs more than one that the whole test then drops. Of 32 hands of Allegro that lift at half the friction
#: 1.3 weights turn away 19, these 9; of 63 that hold a free object at half of it 14 were turned away with 2 weights and
#: two stages of closing, now 9. What nothing holds must be gone when a push ends. At the whole friction the pull is
#: more than the weight: of 25 hands that lift .8 of it another lift test drops 10, of 21 that lift 1.3 of it 3.
HANGS: Final = 0.8
HANGS_WHOLE: Final = 1.3
PULL: Final = 1.8
#: What has passed a limit by so much is lost.
GONE: Final = 1.5
#: Where a free object is pushed: no direction is farther from all of them than 71 degrees.
CORNERS: Final = np.array([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)]) / np.sqrt(3.0)
#: How far supports go away [m]: farther than any scene is high.
AWAY_M: Final = 10.0
#: Added to the score of what holds at the whole friction only.
SLIPS: Final = 1.0
#: Score of what starts too deep.
DEEP: Final = 20.0


@dataclass(frozen=True)
class Frictions:
    """The scene built with `PHYSICS`, at half the friction and at the whole of it; all else is the same."""

    half: Scene
    whole: Scene


class LiftRollout(Lift):
    """Runs short lifts of grasps in one scene. Not for several threads at once."""

    def __init__(self, scenes: Frictions, placed: PlacedGrasps) -> None:
        super().__init__(scenes.half, placed)
        self._scenes = scenes

    def score(self, grasps: GraspSet, row: int, beat: float = np.inf) -> float:
        """Displacement or rotation over its limit when the object has hung at half the friction: below 1 it would pass
        for lifted. Else that at the whole friction, and `SLIPS`; `beat` where that is below 1 + `SLIPS` already."""
        self.scene = self._scenes.half
        if self._begin(grasps, row).outcome is not LiftOutcome.NOT_TRIED:
            return DEEP
        if not self._close(grasps, row, give_up=True, stages=CLOSING) or void(self.data):
            return LOST
        self._save()
        hung = self._hung(HANGS, enough=1.0)
        if hung < 1.0:
            return hung
        if beat < SLIPS + 1.0:
            return beat
        self.scene = self._scenes.whole
        self._restore()
        return SLIPS + self._hung(HANGS_WHOLE)

    def _hung(self, weights: float, enough: float = GONE) -> float:
        """Displacement or rotation over its limit, at its present rate `HOLD_S` after the support has gone; what it is
        now if that is `enough`."""
        self.data.mocap_pos[1] = self._scene_pose[:3] - AWAY_M * self._up
        self.data.xfrc_applied[self.scene.object_body, :3] = -weights * self.scene.push * self._up
        return self._ahead(HANGING, enough)


class PushRollout(Test):
    """Runs short pushes of grasps of a free object. Not for several threads at once."""

    def __init__(self, scenes: Frictions) -> None:
        super().__init__(scenes.half)
        self._scenes = scenes

    def score(self, grasps: GraspSet, row: int) -> float:
        """Worst displacement or rotation over its limit when the object was pushed at half the friction: below 1 it
        would pass for held. Else that at the whole friction, and `SLIPS`."""
        self.scene = self._scenes.half
        if self._start(grasps, row).outcomes[0] is Outcome.PENETRATION:
            return DEEP
        if not self._close(grasps, row, give_up=True, stages=FREE_CLOSING) or void(self.data):
            return LOST
        self._save()
        pushed = self._pushed()
        if pushed < 1.0:
            return pushed
        self.scene = self._scenes.whole
        return SLIPS + self._pushed()

    def _pushed(self) -> float:
        """Worst displacement or rotation over its limit, up to the first push that breaks it."""
        worst = 0.0
        for corner in CORNERS:
            self._restore()
            self.data.xfrc_applied[self.scene.object_body, :3] = PULL * self.scene.push * corner
            self._run(PUSHED * STAGE_S)
            worst = max(worst, LOST if void(self.data) else self._excess())
            if worst >= 1.0:
                break
        return worst


class _Shorts:
    """Short tests of one hand and one object, for several threads at once; the scenes are compiled when they are first
    needed. All that are asked about have the same supports and neighbours."""

    def __init__(
        self, hand: HandModel, obj: ObjectModel, pieces: Callable[[], ConvexPieces], *, threads: int = 1
    ) -> None:
        self.hand, self.obj, self._pieces, self._threads = hand, obj, pieces, threads
        self._scenes: Frictions | None = None
        self._lock = threading.Lock()

    def _each(
        self, test: Callable[[Frictions], Callable[[int], _T]], count: int, placed: PlacedGrasps | None
    ) -> list[_T]:
        """What a test says of each of `count` grasps; `test` makes one for a thread."""
        scenes = self._compiled(placed)

        def work(rows: NDArray[np.intp]) -> list[_T]:
            ask = test(scenes)
            return [ask(int(row)) for row in rows]

        parts = np.array_split(np.arange(count), max(1, min(self._threads, count)))
        if len(parts) == 1:
            return work(parts[0])
        with ThreadPoolExecutor(len(parts), thread_name_prefix="short-test") as pool:
            return [answer for part in pool.map(work, parts) for answer in part]

    def _compiled(self, placed: PlacedGrasps | None) -> Frictions:
        with self._lock:
            if self._scenes is None:
                pieces = self._pieces()
                around = (placed.supports, placed.neighbours) if placed is not None else ()
                whole = PHYSICS if placed is None else LIFTING
                self._scenes = Frictions(
                    *(scene_of(self.hand, self.obj, pieces, physics, *around) for physics in (whole.hardened(), whole))
                )
            return self._scenes


class LiftRollouts(_Shorts):
    """Short lifts of grasps in their scenes."""

    def scores(self, grasps: GraspSet, placed: PlacedGrasps, beat: Floats | None = None) -> Floats:
        """(N,) see `ShortLift.score`."""
        least = np.full(len(grasps), np.inf) if beat is None else beat

        def test(scenes: Frictions) -> Callable[[int], float]:
            short = LiftRollout(scenes, placed)
            return lambda row: short.score(grasps, row, float(least[row]))

        return np.array(self._each(test, len(grasps), placed), float)


class PushRollouts(_Shorts):
    """Short pushes of grasps of a free object."""

    def scores(self, grasps: GraspSet) -> Floats:
        """(N,) see `ShortPush.score`."""
        return np.array(self._each(lambda s: partial(PushRollout(s).score, grasps), len(grasps), None), float)


def push_rollout(
    hand: HandModel, obj: ObjectModel, pieces: Callable[[], ConvexPieces], *, threads: int = 1
) -> Callable[[GraspSet, PlacedGrasps | None, Floats], Floats]:
    """A trial of free grasps as `worker.planners.Wanted` takes it: (N,) scores, below 1 for grasps that hold the object
    under short pushes at half the friction, and below 2 at the whole of it.

    Args:
        hand: the hand.
        obj: the object.
        pieces: gives the object's convex pieces when they are first needed.
        threads: of one call; planners on the CPU call from as many threads as they may use.
    """
    pushes = PushRollouts(hand, obj, pieces, threads=threads)

    def rollout(grasps: GraspSet, placed: PlacedGrasps | None, beat: Floats | None = None) -> Floats:
        return pushes.scores(grasps)

    return rollout


#: Stages of closing and of squeezing.
HANGING_CLOSING: Final = 4
#: Pull of an object that hangs, in its weights: the mean of a smooth rise while it speeds up (`lift.SMOOTHLY`).
RISING: Final = 1.06
#: A change of the load comes over this time, in steps [s]: at once it would weigh up to twice.
LOADING_S: Final = 0.04
LOADS: Final = 5


class FixedRootScene(Lift):
    """A scene whose root is fixed. Not for several threads at once."""

    def _closed(self, grasps: GraspSet, row: int) -> bool:
        """Whether the hand closes around the object and holds on to it."""
        if self._begin(grasps, row).outcome is not LiftOutcome.NOT_TRIED:
            return False
        return self._close(grasps, row, give_up=True, stages=HANGING_CLOSING) and not void(self.data)

    def _hang(self, before: float, mass: float) -> None:
        """Let the object hang, and its weight change from that of `before` to that of `mass` [kg]."""
        self.data.mocap_pos[1] = self._scene_pose[:3] - AWAY_M * self._up
        for load in np.linspace(before, mass, LOADS + 1)[1:]:
            self.data.xfrc_applied[self.scene.object_body, :3] = -RISING * ACCELERATION * load * self._up
            self._run(LOADING_S / LOADS)
