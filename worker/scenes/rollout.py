"""Rollouts of candidates: short lift and clearance check in a scene, short pushes of a free object.
Candidates that pass these tests (`worker.validation.prescreening`) are validated in the whole test."""

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
from graspd.worker.scenes.trajectory import plan_trajectory
from graspd.worker.simulation.environment import PlacedGrasps, Scenes
from graspd.worker.validation.decomposition import ConvexPieces
from graspd.worker.validation.key import Level
from graspd.worker.validation.lift import LiftOutcome
from graspd.worker.validation.lifting import KnownLifts, LiftLevel, validate_lifts
from graspd.worker.validation.prescreening import SLIPS, ShortTests
from graspd.worker.validation.validator import KnownRollouts, validate

#: Added to the score of a candidate that would lift but whose approach is blocked. The sum is worse than the score of
#: any candidate that drops the object after a free approach, and better than the score of a lost object.
BLOCKED: Final = 8.0
#: Added if only the validator detects contact on the approach: the object's convex pieces protrude from its surface.
#: Level `dexgraspbench` does not test the approach.
TOUCHES: Final = 2.0
#: A candidate that fails the whole test scores `SLIPS` + 1 plus this share of its short test's score (at most 1).
FALLS: Final = 0.4
#: Highest score of a candidate that lifts at half friction.
BEST: Final = 0.99


def create_rollout(
    run: ExecutionContext,
    hand: HandModel,
    obj: ObjectModel,
    pieces: Callable[[], ConvexPieces],
    *,
    in_scenes: bool,
    known: dict[str, Any] | None = None,
    level: Level = "standard",
) -> Callable[[GraspSet, PlacedGrasps | None, Floats], Floats] | None:
    """Return the rollout function for the device of `run`, or None. `known` caches verdicts of `level`.
    A GPU has no rollouts of free grasps, since it plans faster than a CPU simulates; in scenes they use all threads."""
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
    """Return a `worker.planners.Rollout` that scores free grasps (N,) by short pushes.
    Grasps with scores below both 2 and `beat` are validated at `level`; those that fail score at least 2."""
    shorts, run = ShortTests(hand, obj, pieces), ExecutionContext(threads=1)

    def rollout(grasps: GraspSet, placed: PlacedGrasps | None, beat: Floats | None = None) -> Floats:
        grasps = grasps.moved(np.zeros(3))
        beat = np.full(len(grasps), np.inf) if beat is None else beat
        score = shorts.scores(grasps, None, beat)
        # Skip candidates that cannot beat the previous score.
        held = np.flatnonzero((score < SLIPS + 1.0) & (score < beat))
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
    """Return a `worker.planners.Rollout` that scores grasps (N,) in scenes by short lifts.
    A grasp with a clear trajectory scores below 1 if it lifts at half friction, below 2 if at full friction.
    Candidates that hold the hanging object briefly are validated by the whole lift test: a squeeze may slowly turn an
    object out of the hand. `threads` are per call; on the CPU, planners already use all threads."""
    shorts, run = ShortTests(hand, obj, pieces, threads=threads), ExecutionContext(threads=threads)

    def rollout(grasps: GraspSet, placed: PlacedGrasps | None, beat: Floats | None = None) -> Floats:
        assert placed is not None, "a lift needs a scene"
        beat = np.full(len(grasps), np.inf) if beat is None else beat
        grasps = grasps.moved(np.zeros(3))
        score = shorts.scores(grasps, placed, beat)
        # Skip candidates that cannot beat the previous score.
        held = np.flatnonzero((score < SLIPS + 1.0) & (score < beat))
        if not len(held):
            return score
        mine, where = grasps.take(held), placed.take(held)
        way = plan_trajectory(hand, obj, mine, where)
        score[held[~way.clear]] += BLOCKED
        free = np.flatnonzero(way.clear)
        coming = replace(mine, approach=way.approach, coming=way.open).take(free)
        score[held[free]] = lift_scores(coming, where.take(free), score[held[free]], beat[held[free]])
        return score

    def lift_scores(grasps: GraspSet, placed: PlacedGrasps, score: Floats, beat: Floats) -> Floats:
        lift = partial(validate_lifts, hand, obj, level=level, pieces=pieces(), known=known, run=run)
        out, hard, found = np.maximum(score, SLIPS), np.zeros(len(score), bool), beat < SLIPS + 1.0
        some = np.flatnonzero(score < SLIPS)
        hard[some] = lift(grasps.take(some), placed.take(some), hard=True).success == 1
        out[hard] = np.minimum(score[hard], BEST)
        # The grasp already has a candidate that lifts at full friction, so this test is skipped.
        out[~hard & found] = beat[~hard & found]
        some = np.flatnonzero(~hard & ~found if level == "lift" else hard | ~found)
        full = lift(grasps.take(some), placed.take(some))
        fell = full.success != 1
        out[some[fell]] = SLIPS + 1.0 + FALLS * np.minimum(score[some[fell]], 1.0)
        touched = some[full.outcome == LiftOutcome.TOUCHED_ON_THE_WAY]
        out[touched] = score[touched] + TOUCHES
        return out

    return rollout


Arrays = dict[str, NDArray[Any]]

#: Larger clearances count as this [m].
FARTHEST_M: Final = 1.0


def lift_level(validation: str) -> LiftLevel:
    """Return the level of the lift test for a job's validation: `dexgraspbench` if chosen, else `lift`."""
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
    """Plan the trajectories of grasps in their scenes, and validate those that are clear.
    At level lift, a grasp that lifts at half friction is not tested at full friction. At level dexgraspbench the
    test at full friction decides, as published. Without `pieces`, only clearance is checked.

    Returns:
        The grasps with `approach`, `coming`, `lift` and `wrist`; and columns of the base shard, with the lift's
        verdict in `quality/success` (-1 if not clear)."""
    assert grasps.scene is not None
    placed = scenes.placed(grasps.scene)
    way = plan_trajectory(hand, obj, grasps, placed)
    wrist = way.wrist if way.wrist.shape[1] else None
    grasps = replace(grasps, approach=way.approach, coming=way.open, lift=way.lift, wrist=wrist)
    count, clear = len(grasps), np.flatnonzero(way.clear)
    columns: Arrays = {"quality/clearance_m": np.minimum(way.least_clearance, FARTHEST_M)}
    success = np.where(way.clear, 0, -1).astype(np.int8)
    columns["quality/success"] = success
    if pieces is None:
        return grasps, columns
    common: dict[str, Any] = {"level": level, "pieces": pieces, "known": known, "run": run}
    outcome, margin = np.zeros(count, np.uint8), np.full(count, np.nan)
    hard = np.full(count, -1, np.int8)
    left, half_first = clear, level == "lift"
    for half in (half_first, not half_first):
        lifts = validate_lifts(hand, obj, grasps.take(left), placed.take(left), hard=half, **common)
        if half:
            hard[left] = lifts.success
        if half_first or not half:
            outcome[left], margin[left] = lifts.outcome, lifts.margin
        # What lifts at half friction needs no test at full friction; what fails at full friction needs none at half.
        left = left[(lifts.success == 1) != half]
    success[clear] = outcome[clear] == LiftOutcome.LIFTED
    hard[outcome != LiftOutcome.LIFTED] = -1
    columns |= {"quality/lift_outcome": outcome, "quality/lift_hard": hard, "quality/verdict_margin": margin}
    return grasps, columns


def outcome_masks(columns: Arrays) -> dict[str, NDArray[np.bool_]]:
    """Return masks (N,) of grasps that are clear, lifted, and lifted at half friction (`scene_verdicts`)."""
    clear = np.asarray(columns["quality/success"] >= 0)
    if "quality/lift_outcome" not in columns:
        return {"clear": clear, "lift": np.zeros_like(clear), "lift_hard": np.zeros_like(clear)}
    lifts = clear & (columns["quality/lift_outcome"] == LiftOutcome.LIFTED)
    return {"clear": clear, "lift": lifts, "lift_hard": columns["quality/lift_hard"] == 1}
