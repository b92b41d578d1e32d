"""Pre-screening of candidates: in a scene clearance and a short lift, around a free object short pushes
(`worker.validation.prescreening`). What passes goes through the validator's own test."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.transforms import Floats
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.grasps import GraspSet
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.scenes.trajectory import plan_way
from graspd.worker.simulation.environment import PlacedGrasps, Scenes
from graspd.worker.validation.decomposition import ConvexPieces
from graspd.worker.validation.key import Level
from graspd.worker.validation.lift import LiftOutcome
from graspd.worker.validation.lifting import KnownLifts, LiftLevel, validate_lifts
from graspd.worker.validation.prescreening import SLIPS, LiftRollouts, push_rollout
from graspd.worker.validation.validator import KnownRollouts, validate

#: Added to the score of a hand that would lift but cannot come: worse than any that can and lets the object fall, since
#: most of these come freely, better than what is lost.
BLOCKED: Final = 8.0
#: Added where only the validator sees the hand touch on its way, for the object's convex pieces stand out from it:
#: the DexGraspBench protocol does not ask for the way.
TOUCHES: Final = 2.0
#: What a hand that holds for the short time of a trial but does not lift is worse than one that lifts.
FALLS: Final = 0.4
#: Highest score of what lifts at half the friction.
BEST: Final = 0.99


def rollout_on(
    run: ExecutionContext,
    hand: HandModel,
    obj: ObjectModel,
    pieces: Callable[[], ConvexPieces],
    *,
    in_scenes: bool,
    known: dict[str, Any] | None = None,
    level: Level = "standard",
) -> Callable[[GraspSet, PlacedGrasps | None, Floats], Floats] | None:
    """The trial for what `run` plans on; None: the planner's own merit chooses. `known` keeps the verdicts of `level`.

    Around free objects a GPU plans faster than the processor tries; in scenes it waits, for all threads that there are.
    """
    on_gpu = run.device.startswith("cuda")
    if not in_scenes:
        return None if on_gpu else hold_rollout(hand, obj, pieces, known=known, level=level)
    threads = run.cores if on_gpu else 1
    return lift_rollout(hand, obj, pieces, threads=threads, known=known, level=lift_level(level))


def hold_rollout(
    hand: HandModel,
    obj: ObjectModel,
    pieces: Callable[[], ConvexPieces],
    *,
    known: KnownRollouts | None = None,
    level: Level = "standard",
) -> Callable[[GraspSet, PlacedGrasps | None, Floats], Floats]:
    """A trial of free grasps as `worker.planners.Wanted` takes it: (N,) scores of short pushes, below 2 for grasps that
    hold the object against the six pushes as well.

    Args:
        hand: the hand.
        obj: the object.
        pieces: gives the object's convex pieces when they are first needed.
        known: keeps the verdicts, for the validator.
        level: of the verdicts.
    """
    short, run = push_rollout(hand, obj, pieces), ExecutionContext(threads=1)

    def rollout(grasps: GraspSet, placed: PlacedGrasps | None, beat: Floats | None = None) -> Floats:
        grasps = grasps.moved(np.zeros(3))
        score = short(grasps, placed, np.zeros(0))
        held = np.flatnonzero(score < SLIPS + 1.0)
        if len(held):
            verdicts = validate(hand, obj, grasps.take(held), level=level, pieces=pieces(), known=known, run=run)
            fell = held[verdicts.success != 1]
            score[fell] = SLIPS + 1.0 + FALLS * np.minimum(score[fell], 1.0)
        return score

    return rollout


def lift_rollout(
    hand: HandModel,
    obj: ObjectModel,
    pieces: Callable[[], ConvexPieces],
    *,
    threads: int = 1,
    known: KnownLifts | None = None,
    level: LiftLevel = "lift",
) -> Callable[[GraspSet, PlacedGrasps | None, Floats], Floats]:
    """A trial as `worker.planners.Wanted` takes it: (N,) scores, below 1 for grasps that lift the object at half the
    friction, and below 2 at the whole of it, and whose way is clear.

    What holds the hanging object for a short time is lifted as the validator does it: a squeeze may turn an object out
    of the hand slowly at first.

    Args:
        hand: the hand.
        obj: the object.
        pieces: gives the object's convex pieces when they are first needed.
        threads: of one call; planners on the CPU call from as many threads as they may use.
        known: keeps the lifts, for the validator.
        level: of the lift test.
    """
    shorts, run = LiftRollouts(hand, obj, pieces, threads=threads), ExecutionContext(threads=threads)

    def rollout(grasps: GraspSet, placed: PlacedGrasps | None, beat: Floats | None = None) -> Floats:
        assert placed is not None, "a lift needs a scene"
        beat = np.full(len(grasps), np.inf) if beat is None else beat
        grasps = grasps.moved(np.zeros(3))
        score = shorts.scores(grasps, placed, beat)
        # What is as good as nothing new is not looked at.
        held = np.flatnonzero((score < SLIPS + 1.0) & (score < beat))
        if not len(held):
            return score
        mine, where = grasps.take(held), placed.take(held)
        way = plan_way(hand, obj, mine, where)
        score[held[~way.clear]] += BLOCKED
        free = np.flatnonzero(way.clear)
        coming = replace(mine, approach=way.approach, coming=way.open).take(free)
        score[held[free]] = lifted(coming, where.take(free), score[held[free]], beat[held[free]])
        return score

    def lifted(grasps: GraspSet, placed: PlacedGrasps, score: Floats, beat: Floats) -> Floats:
        """(k,) scores of hands that hold for a short time and whose way is clear."""
        lift = partial(validate_lifts, hand, obj, level=level, pieces=pieces(), known=known, run=run)
        out, barely = np.maximum(score, SLIPS), score >= SLIPS
        some = np.flatnonzero(~barely)
        hard = lift(grasps.take(some), placed.take(some), hard=True).success == 1
        out[some[hard]] = np.minimum(score[some[hard]], BEST)
        barely[some[~hard]] = True
        out[barely & (beat < SLIPS + 1.0)] = beat[barely & (beat < SLIPS + 1.0)]
        some = np.flatnonzero(~barely | (beat >= SLIPS + 1.0))
        full = lift(grasps.take(some), placed.take(some))
        fell = full.success != 1
        out[some[fell]] = SLIPS + 1.0 + FALLS * np.minimum(score[some[fell]], 1.0)
        touched = some[full.outcome == LiftOutcome.TOUCHED_ON_THE_WAY]
        out[touched] = score[touched] + TOUCHES
        return out

    return rollout


Arrays = dict[str, NDArray[Any]]

#: Clearances beyond this are not told apart [m].
FARTHEST_M: Final = 1.0


def lift_level(validation: str) -> LiftLevel:
    """The level of the lift test at which a job's validator validates in scenes: the DexGraspBench protocol is the
    DexGraspBench protocol there too."""
    return "dexgraspbench" if validation == "dexgraspbench" else "lift"


def scene_verdicts(
    hand: HandModel,
    obj: ObjectModel,
    grasps: GraspSet,
    scenes: Scenes,
    *,
    level: LiftLevel,
    pieces: ConvexPieces | None,
    known: KnownLifts | None = None,
    run: ExecutionContext,
) -> tuple[GraspSet, Arrays]:
    """Plan the way of grasps in their scenes, and validate those that are clear.

    A grasp that does not lift is not lifted at half the friction.

    Args:
        hand: the hand.
        obj: the object.
        grasps: N grasps with `scene`.
        scenes: the scenes.
        level: of the lift test.
        pieces: the object's convex pieces; None: nothing is validated, and grasps are only told clear or not.
        known: see `validate_lifts`.
        run: told of grasps validated; asked between grasps whether to stop.

    Returns:
        The grasps with `approach`, `coming`, `lift` and `wrist`; columns of the base shard, `quality/success` being the
        verdict of the lift (-1: not clear).
    """
    assert grasps.scene is not None
    placed = scenes.placed(grasps.scene)
    way = plan_way(hand, obj, grasps, placed)
    wrist = way.wrist if way.wrist.shape[1] else None
    grasps = replace(grasps, approach=way.approach, coming=way.open, lift=way.lift, wrist=wrist)
    count, clear = len(grasps), np.flatnonzero(way.clear)
    columns: Arrays = {"quality/clearance_m": np.minimum(way.least, FARTHEST_M)}
    success = np.where(way.clear, 0, -1).astype(np.int8)
    columns["quality/success"] = success
    if pieces is None:
        return grasps, columns
    common: dict[str, Any] = {"pieces": pieces, "run": run}
    lifts = validate_lifts(hand, obj, grasps.take(clear), placed.take(clear), level=level, known=known, **common)
    success[clear] = lifts.success
    outcome, margin = np.zeros(count, np.uint8), np.full(count, np.nan)
    outcome[clear], margin[clear] = lifts.outcome, lifts.margin
    lifted = clear[outcome[clear] == LiftOutcome.LIFTED]
    hard = np.full(count, -1, np.int8)
    if len(lifted):
        hard[lifted] = validate_lifts(
            hand, obj, grasps.take(lifted), placed.take(lifted), level=level, hard=True, known=known, **common
        ).success
    columns |= {"quality/lift_outcome": outcome, "quality/lift_hard": hard, "quality/verdict_margin": margin}
    return grasps, columns


def outcomes_in_scenes(columns: Arrays) -> dict[str, NDArray[np.bool_]]:
    """(N,) which grasps are clear, lift, and lift at half the friction, from the columns of `scene_verdicts`."""
    clear = np.asarray(columns["quality/success"] >= 0)
    if "quality/lift_outcome" not in columns:
        return {"clear": clear, "lift": np.zeros_like(clear), "lift_hard": np.zeros_like(clear)}
    lifts = clear & (columns["quality/lift_outcome"] == LiftOutcome.LIFTED)
    return {"clear": clear, "lift": lifts, "lift_hard": columns["quality/lift_hard"] == 1}
