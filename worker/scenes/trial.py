"""The trial that candidates of a grasp go through in their scene: a short lift, and a free way in and out."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from worker.grasps import GraspSet
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel
from worker.quality.referee.decomposition import ConvexPieces
from worker.quality.referee.short import ShortLifts
from worker.scenes.way import plan_way
from worker.simulation.surroundings import Placed

Floats = NDArray[np.float64]

#: Score of a hand that would lift but cannot come: worse than what nearly lifts, better than what is lost.
BLOCKED: Final = 5.0


def lift_trial(
    hand: HandModel, obj: ObjectModel, pieces: Callable[[], ConvexPieces], *, threads: int = 1
) -> Callable[[GraspSet, Placed], Floats]:
    """A trial as `worker.planners.Wanted` takes it: (N,) scores, below 1 for grasps that hold the object when it hangs
    and whose way is clear.

    Args:
        hand: the hand.
        obj: the object.
        pieces: gives the object's convex pieces when they are first needed.
        threads: of one call; planners on the CPU call from as many threads as they may use.
    """
    lifts = ShortLifts(hand, obj, pieces, threads=threads)

    def trial(grasps: GraspSet, placed: Placed) -> Floats:
        score = lifts.scores(grasps, placed)
        held = np.flatnonzero(score < 1.0)
        if len(held):
            way = plan_way(hand, obj, grasps.take(held), placed.take(held))
            score[held[~way.clear]] += BLOCKED
        return score

    return trial
