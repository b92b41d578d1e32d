"""Payload of grasps: the heaviest mass that each lifts out of its scene, or holds under the six pushes.

The hand closes once around the object with its own mass. From there the rise and the hold, or the pushes, are simulated
for other masses: doubled until the object is lost, then bisected. A support bears the weight while the hand closes, so
closing anew around a heavier object changes little.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from service.model.matter import MOST_KG
from worker.engines.mujoco_warnings import void
from worker.grasps import GraspSet
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel
from worker.quality.referee.compiled import scene_of
from worker.quality.referee.decomposition import ConvexPieces
from worker.quality.referee.lift import Lift, LiftOutcome
from worker.quality.referee.model import MujocoOptions, Scene
from worker.quality.referee.protocol import DIRECTIONS, Outcome, Test, Trial
from worker.quality.referee.threads import answers
from worker.run import ALONE, Run
from worker.simulation.surroundings import Placed

Floats = NDArray[np.float64]

#: Bisections of a factor of two: the payload is told downwards, to 2.2 %.
BISECTIONS: Final = 5


class _Weighed(Test):
    """A test in which the object's mass changes. Not for several threads at once: the model is its own."""

    def __init__(self, scene: Scene, *rest: Any) -> None:
        super().__init__(replace(scene, model=copy.copy(scene.model)), *rest)
        self._own = scene.mass
        self._inertia = np.array(scene.model.body_inertia[scene.object_body])

    def _weigh(self, mass: float) -> None:
        model, body = self.scene.model, self.scene.object_body
        self.scene = replace(self.scene, mass=mass)
        model.body_mass[body] = mass
        model.body_inertia[body] = self._inertia * (mass / self._own)
        # Inverse inertias that follow from the mass set how stiff contacts are. What this leaves in the data is put
        # right by what comes next: a state is restored, or a grasp begun.
        mujoco.mj_setConst(model, self.data)

    def _heaviest(self, holds: Callable[[float], bool]) -> float:
        """The heaviest mass [kg] that `holds` is true of, from the object's own on; nan: not even that."""
        low, factor = self._own, 2.0
        if not holds(low):
            return float("nan")
        while low * factor <= MOST_KG and holds(low * factor):
            low *= factor
        for _ in range(BISECTIONS):
            factor = np.sqrt(factor)
            if low * factor <= MOST_KG and holds(low * factor):
                low *= factor
        return low


class LiftPayload(_Weighed, Lift):
    """Of grasps in one scene."""

    def payload(self, grasps: GraspSet, row: int) -> float:
        """[kg]; nan: the grasp does not lift the object."""
        self._weigh(self._own)
        if self._begin(grasps, row).outcome is not LiftOutcome.NOT_TRIED:
            return float("nan")
        if not self._close(grasps, row, give_up=True):
            return float("nan")
        self._save()

        def holds(mass: float) -> bool:
            self._weigh(mass)
            self._restore()
            self._goal = np.zeros(3)
            self.data.xfrc_applied[self.scene.object_body, :3] = -self.scene.push * self._up
            self._rise(grasps, row)
            trial = Trial()
            return self._judge(trial) is Outcome.HELD and self._hold(trial) is Outcome.HELD

        return self._heaviest(holds)


class PushPayload(_Weighed):
    """Of grasps of a free object."""

    __test__ = False

    def payload(self, grasps: GraspSet, row: int) -> float:
        """[kg]; nan: the grasp does not hold the object under the pushes."""
        self._weigh(self._own)
        if self._start(grasps, row).outcomes[0] is Outcome.PENETRATION:
            return float("nan")
        if not self._close(grasps, row, give_up=True) or void(self.data):
            return float("nan")
        self._save()

        def holds(mass: float) -> bool:
            self._weigh(mass)
            for direction in range(len(DIRECTIONS)):
                self._restore()
                self._push(direction)
                if self._hold(Trial()) is not Outcome.HELD:
                    return False
            return True

        return self._heaviest(holds)


def payloads(
    hand: HandModel,
    obj: ObjectModel,
    grasps: GraspSet,
    *,
    pieces: ConvexPieces,
    placed: Placed | None = None,
    held: NDArray[np.bool_] | None = None,
    run: Run = ALONE,
) -> Floats:
    """(N,) heaviest mass that each grasp lifts [kg]; nan: not tried, or it does not lift the object itself.

    Args:
        hand: the hand.
        obj: the object; masses below its own are not tried.
        grasps: N grasps.
        pieces: the object's convex pieces.
        placed: the scenes that they lift it out of; None: a free object is pushed six ways.
        held: (N,) which grasps are tried; None: all.
        run: asked between grasps whether to stop.

    Raises:
        TaskCancelled: when `run.cancelled()` answers True.
    """
    out = np.full(len(grasps), np.nan)
    rows = np.arange(len(grasps)) if held is None else np.flatnonzero(held)
    if not len(rows):
        return out
    around = (placed.supports, placed.neighbours) if placed is not None else ()
    scene = scene_of(hand, obj, pieces, MujocoOptions(), *around)

    def ask(test: LiftPayload | PushPayload, row: int) -> float:
        run.check("the referee")
        return test.payload(grasps, row)

    def make() -> LiftPayload | PushPayload:
        return PushPayload(scene) if placed is None else LiftPayload(scene, placed)

    out[rows] = answers(rows.tolist(), make, ask, threads=run.cores, name="payload")
    return out
