"""The trial that candidates of a grasp go through: in their scene a short lift, and a free way in and out; around a
free object short pushes (`worker.quality.referee.short`)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from worker.grasps import GraspSet
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel
from worker.quality.referee.decomposition import ConvexPieces
from worker.quality.referee.short import SLIPS, ShortLifts, push_trial
from worker.run import Run
from worker.scenes.way import plan_way
from worker.simulation.surroundings import Placed

Floats = NDArray[np.float64]

#: Added to the score of a hand that would lift but cannot come: worse than any that can and lets the object fall, since
#: most of these come freely, better than what is lost.
BLOCKED: Final = 8.0
#: Added where only the referee sees the hand touch on its way, for the object's convex pieces stand out from it:
#: the letter does not ask for the way.
TOUCHES: Final = 2.0


def trial_on(
    run: Run, hand: HandModel, obj: ObjectModel, pieces: Callable[[], ConvexPieces], *, in_scenes: bool
) -> Callable[[GraspSet, Placed | None], Floats] | None:
    """The trial for what `run` plans on; None: the planner's own merit chooses.

    Around free objects a GPU plans faster than the processor tries; in scenes it waits, for all threads that there are.
    """
    if not run.device.startswith("cuda"):
        return lift_trial(hand, obj, pieces) if in_scenes else push_trial(hand, obj, pieces)
    return lift_trial(hand, obj, pieces, threads=run.apart().cores) if in_scenes else None


def lift_trial(
    hand: HandModel, obj: ObjectModel, pieces: Callable[[], ConvexPieces], *, threads: int = 1
) -> Callable[[GraspSet, Placed | None], Floats]:
    """A trial as `worker.planners.Wanted` takes it: (N,) scores, below 1 for grasps that hold the object when it hangs
    at half the friction, and below 2 at the whole of it, and whose way is clear.

    Args:
        hand: the hand.
        obj: the object.
        pieces: gives the object's convex pieces when they are first needed.
        threads: of one call; planners on the CPU call from as many threads as they may use.
    """
    lifts = ShortLifts(hand, obj, pieces, threads=threads)

    def trial(grasps: GraspSet, placed: Placed | None) -> Floats:
        assert placed is not None, "a lift needs a scene"
        score = lifts.scores(grasps, placed)
        held = np.flatnonzero(score < SLIPS + 1.0)
        if len(held):
            mine, where = grasps.take(held), placed.take(held)
            way = plan_way(hand, obj, mine, where)
            score[held[~way.clear]] += BLOCKED
            free = np.flatnonzero(way.clear)
            coming = replace(mine, approach=way.approach, coming=way.open).take(free)
            score[held[free[~lifts.come(coming, where.take(free))]]] += TOUCHES
        return score

    return trial
