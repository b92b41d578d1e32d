"""Candidates of a grasp: ranked by contact balance, then simulated in turn until one is good enough."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.transforms import Floats, Mask, quat_rotate
from graspd.worker.control.postures import hold_forces, normal_force, pregrasp, squeeze
from graspd.worker.grasps import GraspSet, Posture, join_grasp_sets
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.simulation.data import HandState
from graspd.worker.simulation.environment import PlacedGrasps

Ints = NDArray[np.intp]

#: Number of candidates of a grasp in one fine phase. Their refinement costs half of a rollout.
TOGETHER: Final = 2
#: Merit from which on a refined hand has no rollout, unless its grasp's best score exceeds `POOR`. Of 176 Allegro and
#: Shadow hands above it, 3 lifted at half friction.
HOPEFUL: Final = 0.3
#: Scores above this mean a lost object or a blocked trajectory.
POOR: Final = 7.0
#: Share of the squeeze force in the second rollout of hands with scores from 1 to `NEARLY`. Of 144 Shadow hands, .80
#: lift with the whole force, .83 with half of it, .92 with the best of six forces.
GENTLER: Final = 0.5
NEARLY: Final = 2.5
#: Score below which no further candidate is simulated, for free grasps and in scenes. Scores below 1 mean that the
#: grasp holds in a short test at half friction. For free grasps, a limit of 0.5 takes a tenth more time than 1. The
#: share that holds in validation at half friction rises: Shadow .70 to .76, Allegro .81 to .88, Barrett .83 to .92.
GOOD: Final = 0.5
GOOD_IN_SCENES: Final = 0.995
#: Penalty on the merit of a hand in a scene if a finger stands off the object, and least score of such a hand. Other
#: hands that lift at half friction have lower scores.
STANDING_OFF: Final = 0.2
BEST_OFF: Final = 0.999
#: Score of candidates without a rollout.
HOPELESS: Final = 1e9


def grasps_of_state(
    hand: HandModel,
    obj: ObjectModel,
    state: HandState,
    losses: Floats,
    placed: PlacedGrasps | None,
    *,
    device: str = "cpu",
) -> GraspSet:
    grasp = posture_of(hand, obj, state)
    before = pregrasp(hand, obj, grasp, placed, device=device)
    return GraspSet(grasp, before, squeeze(hand, obj, grasp, device=device), losses)


@dataclass(frozen=True)
class Refinements:
    """Hands after the fine phase; hands of one grasp are adjacent."""

    state: HandState
    losses: Floats
    merit: Floats
    infeasible: Mask
    """Whether penetration depth or number of touching links fails the geometric gate; no rollout follows."""
    off: Mask
    """Whether a finger stands off an object in a scene. Such hands are simulated last."""


Seat = Callable[[Ints, Ints], Refinements]
"""Runs the fine phase for some grasps (n,), given the rows (n, each) of their starts."""

RolloutOf = Callable[[GraspSet, Ints, Floats], Floats]
"""Returns scores (k,) of grasps from their numbers (k,) and scores to beat (k,); see `worker.planners.Rollout`."""


@dataclass
class Selection:
    """Best candidate so far of each of n grasps; grasps without a candidate are not in `grasps`."""

    state: HandState
    losses: Floats
    score: Floats
    grasps: dict[int, GraspSet]

    @classmethod
    def empty(cls, beat: Floats, dofs: int) -> Selection:
        """Return a selection without candidates; its scores are `beat` (n,)."""
        count = len(beat)
        empty = HandState(np.zeros((count, 3)), np.zeros((count, 4)), np.zeros((count, dofs)))
        return cls(empty, np.zeros(count), beat.copy(), {})

    def has_candidates(self, which: Ints) -> Mask:
        return np.array([int(grasp) in self.grasps for grasp in which], bool)

    def take(self, found: GraspSet, refined: Refinements, rows: Ints, which: Ints, score: Floats) -> None:
        """Store candidates `rows` (k,) of the grasps `which` (k,) that are better or a grasp's first."""
        state, losses = refined.state[rows], refined.losses[rows]
        for k in np.flatnonzero((score < self.score[which]) | ~self.has_candidates(which)):
            grasp = int(which[k])
            self.grasps[grasp] = found.take(slice(k, k + 1))
            self.score[grasp], self.losses[grasp] = min(score[k], self.score[grasp]), losses[k]
            for name in ("pivot", "rotation", "q"):
                getattr(self.state, name)[grasp] = getattr(state, name)[k]

    def joined(self) -> GraspSet:
        return join_grasp_sets([self.grasps[k] for k in range(len(self.score))])


def select_by_rollout(
    hand: HandModel,
    obj: ObjectModel,
    order: Ints,
    refine: Seat,
    placed: PlacedGrasps | None,
    rollout: RolloutOf,
    *,
    beat: Floats | None = None,
    unlike: NDArray[np.bool_] | None = None,
    together: int = TOGETHER,
    device: str = "cpu",
) -> Selection:
    """Return each grasp's first candidate with a good enough rollout, else the one with the least score.
    `order` (n, each) lists the candidates by merit. `together` candidates of each grasp are refined and simulated, then
    further ones of grasps without a good candidate. Unbalanced or infeasible hands have no rollout; a grasp of only
    such hands gets its first hand. A hand of the mask `unlike` is refined only beside others, or first. Scores `beat`
    (n,) of earlier attempts change only if a candidate is better."""
    good = GOOD if placed is None else GOOD_IN_SCENES
    beat = np.full(len(order), np.inf) if beat is None else beat
    taken, left = Selection.empty(beat, hand.dofs), np.arange(len(order))
    for number, wave in enumerate(np.split(order, range(together, order.shape[1], together), axis=1)):
        if number and unlike is not None:
            left = left[~unlike[wave[left]].all(axis=1)]
        if not len(left):
            break
        refined = refine(wave[left], left)
        for rows in rank_hands(refined.merit + STANDING_OFF * refined.off, len(left)).T:
            worth = (refined.merit[rows] < HOPEFUL) | (taken.score[left] > POOR)
            open_ = ~(taken.score[left] < good) & (worth & ~refined.infeasible[rows] | ~taken.has_candidates(left))
            if not open_.any():
                continue
            which = left[open_]
            where = placed.take(which) if placed is not None else None
            found = grasps_of_state(
                hand, obj, refined.state[rows[open_]], refined.losses[rows[open_]], where, device=device
            )
            hopeless = refined.infeasible[rows[open_]] | ~worth[open_]
            score = _scores(found, hopeless, which, taken.score[which], rollout)
            _reduce_squeeze(hand, obj, found, score, which, rollout, device)
            score = np.where(refined.off[rows[open_]] & (score < BEST_OFF), BEST_OFF, score)
            taken.take(found, refined, rows[open_], which, score)
        left = left[~(taken.score[left] < good)]
    return taken


def _scores(found: GraspSet, infeasible: Mask, which: Ints, beat: Floats, rollout: RolloutOf) -> Floats:
    score, feasible = np.full(len(which), HOPELESS), np.flatnonzero(~infeasible)
    if len(feasible):
        score[feasible] = np.nan_to_num(
            rollout(found.take(feasible), which[feasible], beat[feasible]), nan=HOPELESS, posinf=HOPELESS
        )
    return score


def _reduce_squeeze(
    hand: HandModel, obj: ObjectModel, found: GraspSet, score: Floats, which: Ints, rollout: RolloutOf, device: str
) -> None:
    """Reduce the squeeze force of hands (k,) that nearly lift if this improves their scores.
    Soft fingers act as springs: a larger force turns the object farther out of the hand."""
    poor = np.flatnonzero((score >= 1.0) & (score < NEARLY))
    if not len(poor):
        return
    gentle = found.take(poor)
    gentle.squeeze = squeeze(hand, obj, gentle.grasp, total_normal_force=GENTLER * normal_force(obj), device=device)
    again = _scores(gentle, np.zeros(len(poor), bool), which[poor], score[poor], rollout)
    better = again < score[poor]
    found.squeeze.joint_positions[poor[better]] = gentle.squeeze.joint_positions[better]
    score[poor[better]] = again[better]


#: Friction coefficient in the balance of contact forces. It is below those of all tests, as a reserve.
FRICTION: Final = 0.3
#: The same in scenes. The merit with this friction predicts lifts at half friction with an AUC of .80, against .74 with
#: `FRICTION` (refined Allegro and Shadow hands with a merit below .1).
SCENE_FRICTION: Final = 0.15
#: Weight of L_stable relative to the residual of the balance.
STABILITY: Final = 0.05
#: Weight [1/m] of penetration above the tolerance [m]. One more millimetre outweighs most of the residual.
DEPTH: Final = 200.0
TOLERATED_M: Final = 5e-4
#: Weight of the share of the hand's surface within `NEAR_M` [m] of a free object after the coarse phase. Of equally
#: balanced hands, those that enclose more of the object are refined first.
NEARNESS: Final = 2.0
NEAR_M: Final = 0.005


def posture_of(hand: HandModel, obj: ObjectModel, state: HandState) -> Posture:
    root = state.pivot + obj.centre_of_mass - quat_rotate(state.rotation, hand.palm.centre)
    return Posture(np.concatenate([root, state.rotation], axis=1), hand.expand(state.q))


def merits(
    hand: HandModel,
    obj: ObjectModel,
    state: HandState,
    losses: Floats,
    depths: Floats | None = None,
    *,
    friction: float = FRICTION,
    device: str = "cpu",
) -> Floats:
    """Compute merits (n,); smaller is better.
    A merit is the residual of the force balance with `friction`, plus weighted `losses` (n,) (L_stable) and penetration
    `depths` (n,) [m]."""
    holds = hold_forces(hand, obj, posture_of(hand, obj, state), friction=friction, device=device)
    merit = holds.residual + STABILITY * losses
    if depths is not None:
        merit += DEPTH * np.maximum(depths - TOLERATED_M, 0.0)
    return merit


def rank_hands(merit: Floats, grasps: int) -> Ints:
    """Return row numbers (grasps, each) of hands, best first; in `merit` hands of a grasp are adjacent."""
    each = merit.reshape(grasps, -1)
    # The stable sort keeps hands of equal merit in the order of their starts.
    return np.argsort(each, axis=1, kind="stable") + np.arange(grasps)[:, None] * each.shape[1]
