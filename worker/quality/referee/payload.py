"""Payload of grasps: the heaviest mass that each lifts out of its scene, or holds under the six pushes.

The hand closes once around the object with its own mass. Then the object hangs, or is pushed, with other masses until
its motion tells how that ends: first what the forces of the closed hand and friction bear, then nearer and nearer, each
from where the heaviest one so far hangs.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from service.model.matter import ACCELERATION, MOST_KG
from service.model.transforms import Floats
from worker.engines.mujoco_warnings import void
from worker.grasps import GraspSet
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel
from worker.quality.referee.compiled import scene_of
from worker.quality.referee.decomposition import ConvexPieces
from worker.quality.referee.hanging import CLOSING, Hanging
from worker.quality.referee.model import Scene
from worker.quality.referee.protocol import DIRECTIONS, Outcome, Test
from worker.quality.referee.short import LIFTING
from worker.quality.referee.threads import measured
from worker.run import ALONE, Run
from worker.simulation.surroundings import Placed

#: The payload is told downwards, to this ratio.
TOLD: Final = 1.03
#: Share of the friction bound that is tried first, its median over the grasps of `benchmarks.payload`; and the first
#: step from there.
FIRST: Final = 0.75
STEP: Final = math.sqrt(2)
#: Stages that a load is watched at most.
WATCHED: Final = 10


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

    def _bound(self, against: Floats) -> float:
        """Mass [kg] whose weight along -`against` (3,) the contacts of the closed hand bear by their present normal
        forces and friction. An estimate: a load changes these forces."""
        contact, model = self.data.contact, self.scene.model
        at_object = model.geom_bodyid[contact.geom] == self.scene.object_body
        rows = np.flatnonzero(
            self.scene.hand_geoms[contact.geom].any(axis=1) & at_object.any(axis=1) & (contact.efc_address >= 0)
        )
        # A normal points from the first geom to the second.
        along = contact.frame[rows, :3] @ against * np.where(at_object[rows, 1], 1, -1)
        slide = contact.friction[rows, 0] * np.sqrt(np.maximum(0.0, 1 - along**2))
        return float(self.data.efc_force[contact.efc_address[rows]] @ (along + slide)) / ACCELERATION

    def _heaviest(self, bears: Callable[[float], bool], first: float) -> float:
        """The heaviest mass [kg] that `bears` is true of, tried from `first` on, none below the object's own; nan: not
        even that."""
        low, high, step, borne = self._own, math.inf, STEP, False
        mass = min(max(first, low), MOST_KG)
        while True:
            if bears(mass):
                low, borne = mass, True
            elif mass <= self._own:
                return math.nan
            else:
                high = mass
            if borne and (low >= MOST_KG or high <= TOLD * low):
                return low
            if borne and high < math.inf:
                mass = math.sqrt(low * high)
            else:
                mass = min(low * step, MOST_KG) if borne else max(high / step, low)
                step **= 2


class LiftPayload(_Weighed, Hanging):
    """Of grasps in one scene."""

    def payload(self, grasps: GraspSet, row: int) -> float:
        """[kg]; nan: the grasp does not lift the object."""
        self._weigh(self._own)
        if not self._closed(grasps, row):
            return math.nan
        self._save()
        borne = 0.0

        def bears(mass: float) -> bool:
            nonlocal borne
            self._weigh(mass)
            self._restore()
            self._hang(borne, mass)
            if self._ahead(WATCHED) >= 1.0:
                return False
            self._save()
            borne = mass
            return True

        return self._heaviest(bears, FIRST * self._bound(self._up))


class PushPayload(_Weighed):
    """Of grasps of a free object."""

    __test__ = False

    def payload(self, grasps: GraspSet, row: int) -> float:
        """[kg]; nan: the grasp does not hold the object under the pushes."""
        self._weigh(self._own)
        if self._start(grasps, row).outcomes[0] is Outcome.PENETRATION:
            return math.nan
        if not self._close(grasps, row, give_up=True, stages=CLOSING) or void(self.data):
            return math.nan
        self._save()
        bounds = [self._bound(-np.array(direction, float)) for direction in DIRECTIONS]
        weakest_first = np.argsort(bounds).tolist()

        def bears(mass: float) -> bool:
            self._weigh(mass)
            for direction in weakest_first:
                self._restore()
                self._push(direction)
                if self._ahead(WATCHED) >= 1.0:
                    # Of the next masses, too, it is asked first.
                    weakest_first.remove(direction)
                    weakest_first.insert(0, direction)
                    return False
            return True

        return self._heaviest(bears, FIRST * min(bounds))


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

    def make() -> LiftPayload | PushPayload:
        around = (placed.supports, placed.neighbours) if placed is not None else ()
        scene = scene_of(hand, obj, pieces, LIFTING, *around)
        return PushPayload(scene) if placed is None else LiftPayload(scene, placed)

    return measured(len(grasps), held, make, lambda test, row: test.payload(grasps, row), run=run, name="payload")
