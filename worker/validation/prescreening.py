"""Short tests with coarse physics that rank a planner's candidates at a fifth of a verdict's cost.

The hand closes and squeezes around the object. In a scene the support is then removed, and most of the object's weight
pulls for a moment. A free object is pushed towards the corners of a tetrahedron, with nearly twice its weight. Friction
is halved. Objects that slip are tested once more from the same closed hand at full friction; in a scene the pull is
then 30 % above the weight. The full test still validates the selected candidates."""

import threading
from collections.abc import Callable
from typing import Final, TypeVar

import numpy as np

from graspd.service.model.matter import ACCELERATION
from graspd.service.model.transforms import Floats
from graspd.worker.engines.mujoco_warnings import is_invalid
from graspd.worker.execution_context import evaluate_rows
from graspd.worker.grasps import GraspSet
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.simulation.environment import PlacedGrasps
from graspd.worker.validation.decomposition import ConvexPieces
from graspd.worker.validation.lift import Lift, LiftOutcome
from graspd.worker.validation.model import MujocoOptions, Scene, scene_of
from graspd.worker.validation.protocol import LOST, STAGE_S, Outcome, Test

T = TypeVar("T")

#: The root is fixed, because the protocol's compliant root costs twice as much. MuJoCo's iterations against slip are
#: off: in so short a time they make no difference.
PHYSICS: Final = MujocoOptions(timestep=0.006, root="fixed", noslip_iterations=0)
#: Physics of lifts: with coarser contacts the object creeps under its own weight.
LIFTING: Final = MujocoOptions(root="fixed")
#: Number of stages of closing and of squeezing; number of stages of hanging.
CLOSING: Final = 2
HANGING: Final = 6
#: The same numbers for a free object and a push.
FREE_CLOSING: Final = 3
PUSHED: Final = 2
#: Pulls in object weights: hanging at half friction, hanging at full friction, and push. Rejecting a good candidate
#: costs more than accepting one that fails the full test. Of 32 Allegro candidates that lift at half friction, 1.3
#: weights reject 19, the present value 9. Of 63 that hold a free object at half friction, 2 weights and two stages of
#: closing reject 14, the present values 9. A push must be strong enough to move an object that is not held. At full
#: friction the pull exceeds the weight: of 25 candidates that lift .8 weights, 10 fail another lift test; of 21 that
#: lift 1.3 weights, 3 fail it.
HANGS: Final = 0.8
HANGS_WHOLE: Final = 1.3
PULL: Final = 1.8
GONE: Final = 1.5  # ratio of motion to its limit from which on the object is lost
#: Push directions of a free object: every direction is within 71 degrees of one of them.
CORNERS: Final = np.array([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)]) / np.sqrt(3.0)
AWAY_M: Final = 10.0  # distance by which supports are removed [m]: more than the height of any scene
SLIPS: Final = 1.0  # added to the score of grasps that hold only at full friction
DEEP: Final = 20.0  # score of grasps that start in deep penetration
Frictions = tuple[Scene, Scene]  # scenes compiled at half and at full friction; everything else is the same


class ShortLiftTest(Lift):
    """Short lifts of grasps in one scene. Not thread-safe."""

    def __init__(self, scenes: Frictions, placed: PlacedGrasps) -> None:
        super().__init__(scenes[0], placed)
        self._half, self._whole = scenes

    def score(self, grasps: GraspSet, row: int, beat: float = np.inf) -> float:
        """Return the ratio of motion to its limit after hanging at half friction; below 1 if lifted.
        Otherwise return the ratio at full friction plus `SLIPS`, or `beat` if `beat` is below 1 + `SLIPS`."""
        self.scene = self._half
        if self._set_up_scene(grasps, row).outcome is not LiftOutcome.NOT_TRIED:
            return DEEP
        if not self._close(grasps, row, give_up=True, stages=CLOSING) or is_invalid(self.data):
            return LOST
        self._save()
        hung = self._hang_score(HANGS, enough=1.0)
        if hung < 1.0:
            return hung
        if beat < SLIPS + 1.0:
            return beat
        self.scene = self._whole
        self._restore()
        return SLIPS + self._hang_score(HANGS_WHOLE)

    def _hang_score(self, weights: float, enough: float = GONE) -> float:
        """Return the ratio of motion to its limit, extrapolated to `HOLD_S` after removal of the supports.
        As soon as the present ratio reaches `enough`, return it without extrapolation."""
        self.data.mocap_pos[1] = self._scene_pose[:3] - AWAY_M * self._up
        self.data.xfrc_applied[self.scene.object_body, :3] = -weights * self.scene.push_force * self._up
        return self._extrapolate(HANGING, enough)


class ShortPushTest(Test):
    """Short pushes of grasps of a free object. Not thread-safe."""

    def __init__(self, scenes: Frictions) -> None:
        super().__init__(scenes[0])
        self._half, self._whole = scenes

    def score(self, grasps: GraspSet, row: int, beat: float = np.inf) -> float:
        """Return the largest ratio of motion to its limit in pushes at half friction; below 1 if held.
        Otherwise return the ratio at full friction plus `SLIPS`, or inf as soon as the score cannot be below `beat`."""
        self.scene = self._half
        if self.set_up(grasps, row).outcomes[0] is Outcome.PENETRATION:
            return DEEP
        if not self._close(grasps, row, give_up=True, stages=FREE_CLOSING) or is_invalid(self.data):
            return LOST
        self._save()
        pushed = self._push_score(min(beat, 1.0))
        if pushed < min(beat, 1.0):
            return pushed
        if beat < SLIPS + 1.0:
            return np.inf
        self.scene = self._whole
        return SLIPS + self._push_score()

    def _push_score(self, enough: float = 1.0) -> float:
        """Return the largest ratio of motion to its limit; stop at the first push that reaches `enough`."""
        worst = 0.0
        for corner in CORNERS:
            self._restore()
            self.data.xfrc_applied[self.scene.object_body, :3] = PULL * self.scene.push_force * corner
            self._run(PUSHED * STAGE_S)
            worst = max(worst, LOST if is_invalid(self.data) else self._motion_excess())
            if worst >= enough:
                break
        return worst


class ShortTests:
    """Short tests of one hand and one object with common supports and neighbours; thread-safe."""

    def __init__(
        self, hand: HandModel, obj: ObjectModel, pieces: Callable[[], ConvexPieces], *, threads: int = 1
    ) -> None:
        self.hand, self.obj, self._pieces, self.threads = hand, obj, pieces, threads
        self._scenes: Frictions | None = None
        self._lock = threading.Lock()

    def scores(self, grasps: GraspSet, placed: PlacedGrasps | None, beat: Floats | None = None) -> Floats:
        """Return scores (N,) (`worker.planners.Rollout`), by lifts if `placed` is given, else by pushes.
        Scores are below 1 for grasps that hold at half friction, and below 2 for those that hold at full friction."""
        with self._lock:
            if self._scenes is None:
                around = (placed.supports, placed.neighbours) if placed is not None else ()
                whole, pieces = PHYSICS if placed is None else LIFTING, self._pieces()
                half, full = (
                    scene_of(self.hand, self.obj, pieces, physics, *around) for physics in (whole.hardened(), whole)
                )
                self._scenes = half, full
        scenes, least = self._scenes, np.full(len(grasps), np.inf) if beat is None else beat

        def make() -> ShortLiftTest | ShortPushTest:
            return ShortPushTest(scenes) if placed is None else ShortLiftTest(scenes, placed)

        def score(test: ShortLiftTest | ShortPushTest, row: int) -> float:
            return test.score(grasps, row, float(least[row]))

        return np.array(evaluate_rows(range(len(grasps)), make, score, threads=self.threads, name="short-test"), float)


HANGING_CLOSING: Final = 4  # number of stages of closing and of squeezing
#: Pull on a hanging object, in weights: mean over the accelerating part of a smooth rise (`lift.SMOOTHLY`).
RISING: Final = 1.06
#: Duration of a load change [s], and number of its steps; a sudden change would act like up to twice the load.
LOADING_S: Final = 0.04
LOADS: Final = 5


class FixedRootTest(Lift):
    """Tests in a scene with a fixed root: the hand closes, and the object hangs. Not thread-safe."""

    def _closed(self, grasps: GraspSet, row: int) -> bool:
        """Close the hand around the object; return whether the object stays in the hand."""
        if self._set_up_scene(grasps, row).outcome is not LiftOutcome.NOT_TRIED:
            return False
        return self._close(grasps, row, give_up=True, stages=HANGING_CLOSING) and not is_invalid(self.data)

    def _hang(self, before: float, mass: float) -> None:
        """Let the object hang while its weight changes from the mass `before` to `mass` [kg]."""
        self.data.mocap_pos[1] = self._scene_pose[:3] - AWAY_M * self._up
        for load in np.linspace(before, mass, LOADS + 1)[1:]:
            self.data.xfrc_applied[self.scene.object_body, :3] = -RISING * ACCELERATION * load * self._up
            self._run(LOADING_S / LOADS)
