"""What a hand lifts at best, where none of its grasps lifts what it should: measured, and bounded by its actuators."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from service.model.matter import MASS_KG
from service.model.planning import limit_told
from worker.grasps import GraspSet
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel
from worker.quality.capacity import capacities
from worker.quality.referee.decomposition import ConvexPieces
from worker.quality.referee.payload import payloads
from worker.quality.referee.protocol import DIRECTIONS
from worker.run import ALONE, Run
from worker.simulation.surroundings import Placed

#: Grasps that must lift what weighs little, before what they lift is told as the hand's limit: else their shape may be
#: why. It weighs as much as an object of which nothing is said, or this share of what is wanted.
LEAST: Final = 2
LIGHT: Final = 1 / 8
#: So many grasps show that no further ones need be tried.
ENOUGH: Final = 8
#: What is wanted over what the best of them lifts, from which on no further ones are tried.
HOPELESS: Final = 2.0


@dataclass(frozen=True)
class Limit:
    """What some grasps of a hand lift."""

    hand: str
    friction: float
    grasps: int
    lifts_kg: float
    """Payload of the best, by simulated lifts."""
    bound_kg: float
    """Largest load capacity of one (`worker.quality.capacity`)."""
    wanted_kg: float | None = None
    """What they should lift; None: nobody asked."""

    @property
    def hopeless(self) -> bool:
        """Whether what is wanted is so much more that further grasps need not be tried."""
        return self.grasps >= ENOUGH and self.wanted_kg is not None and self.wanted_kg > HOPELESS * self.lifts_kg

    @property
    def line(self) -> str:
        """A sentence for people."""
        return limit_told(self.hand, self.friction, self.grasps, self.lifts_kg, self.bound_kg, self.wanted_kg)

    def facts(self) -> dict[str, Any]:
        """For JSON; no bound: None."""
        bound = round(self.bound_kg, 3) if math.isfinite(self.bound_kg) else None
        return {"lifts_kg": round(self.lifts_kg, 3), "bound_kg": bound, "grasps": self.grasps, "says": self.line}


def limit_of(
    hand: HandModel,
    obj: ObjectModel,
    grasps: GraspSet,
    *,
    pieces: ConvexPieces,
    placed: Placed | None = None,
    wanted: float | None = None,
    least: int = LEAST,
    run: Run = ALONE,
) -> Limit | None:
    """What the best of N grasps lifts; None: it lifts as much as is wanted, or fewer than `least` lift anything.

    Args:
        hand: the hand.
        obj: the object.
        grasps: N grasps.
        pieces: the object's convex pieces.
        placed: their scenes; None: the object is free.
        wanted: mass that should be lifted [kg]; None: nobody asked.
        least: grasps that must lift what weighs little.
        run: asked between grasps whether to stop.

    Raises:
        TaskCancelled: when `run.cancelled()` answers True.
    """
    if len(grasps) < least:
        return None
    light = obj.weighing(mass=MASS_KG if wanted is None else min(MASS_KG, LIGHT * wanted))
    found = payloads(hand, light, grasps, pieces=pieces, placed=placed, run=run)
    if np.isfinite(found).sum() < least:
        return None
    lifts = float(np.nanmax(found))
    if wanted is not None and lifts >= wanted:
        return None
    against = np.broadcast_to(-np.array(DIRECTIONS, float), (len(grasps), len(DIRECTIONS), 3))
    if placed is not None:
        against = np.array([[placed.scenes[number].up] for number in placed.index])
    bound = float(capacities(hand, obj, grasps.grasp, against).max())
    return Limit(hand.name, obj.friction, len(grasps), lifts, max(bound, lifts), wanted)
