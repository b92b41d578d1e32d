"""What grasps are worth in their scenes: are they clear, and do they lift the object, at half the friction too?"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from worker.grasps import GraspSet
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel
from worker.quality.referee.decomposition import ConvexPieces
from worker.quality.referee.lift import LiftOutcome
from worker.quality.referee.lifting import KnownLifts, LiftLevel, judge_lifts
from worker.run import Run
from worker.scenes.way import plan_way
from worker.simulation.surroundings import Scenes

Arrays = dict[str, NDArray[Any]]

#: Clearances beyond this are not told apart [m].
FARTHEST_M: Final = 1.0


def lift_level(referee: str) -> LiftLevel:
    """The level of the lift test at which a job's referee judges in scenes: the letter is the letter there too."""
    return "letter" if referee == "letter" else "lift"


def scene_verdicts(
    hand: HandModel,
    obj: ObjectModel,
    grasps: GraspSet,
    scenes: Scenes,
    *,
    level: LiftLevel,
    pieces: ConvexPieces | None,
    known: KnownLifts | None = None,
    run: Run,
) -> tuple[GraspSet, Arrays, dict[str, int]]:
    """Plan the way of grasps in their scenes, and judge those that are clear.

    A grasp that does not lift is not lifted at half the friction.

    Args:
        hand: the hand.
        obj: the object.
        grasps: N grasps with `scene`.
        scenes: the scenes.
        level: of the lift test.
        pieces: the object's convex pieces; None: nobody judges, and grasps are only told clear or not.
        known: see `judge_lifts`.
        run: told of grasps judged; asked between grasps whether to stop.

    Returns:
        The grasps with `approach`, `coming`, `lift` and `wrist`; columns of the base shard, `quality/success` being the
        verdict of the lift (-1: not clear); how many are clear, lift, and lift_hard.
    """
    assert grasps.scene is not None
    placed = scenes.placed(grasps.scene)
    way = plan_way(hand, obj, grasps, placed)
    wrist = way.wrist if way.wrist.shape[1] else None
    grasps = replace(grasps, approach=way.approach, coming=way.open, lift=way.lift, wrist=wrist)
    count, clear = len(grasps), np.flatnonzero(way.clear)
    columns: Arrays = {"quality/clearance_m": np.minimum(way.least, FARTHEST_M)}
    counts = {"clear": len(clear), "lift": 0, "lift_hard": 0}
    success = np.where(way.clear, 0, -1).astype(np.int8)
    columns["quality/success"] = success
    if pieces is None:
        return grasps, columns, counts
    common: dict[str, Any] = {"pieces": pieces, "run": run}
    lifts = judge_lifts(hand, obj, grasps.take(clear), placed.take(clear), level=level, known=known, **common)
    success[clear] = lifts.success
    outcome, margin = np.zeros(count, np.uint8), np.full(count, np.nan)
    outcome[clear], margin[clear] = lifts.outcome, lifts.margin
    lifted = clear[outcome[clear] == LiftOutcome.LIFTED]
    hard = np.full(count, -1, np.int8)
    if len(lifted):
        hard[lifted] = judge_lifts(
            hand, obj, grasps.take(lifted), placed.take(lifted), level=level, hard=True, known=known, **common
        ).success
    counts |= {"lift": len(lifted), "lift_hard": int((hard == 1).sum())}
    return (
        grasps,
        columns
        | {
            "quality/lift_outcome": outcome,
            "quality/lift_hard": hard,
            "quality/verdict_margin": margin,
        },
        counts,
    )
