"""Candidates of a grasp, ranked by contact balance and simulated in turn until one is good enough."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.transforms import Floats, quat_rotate
from graspd.worker.control.postures import hold_forces, normal_force, pregrasp, squeeze
from graspd.worker.grasps import GraspSet, Posture, joined
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.simulation.data import HandState
from graspd.worker.simulation.environment import PlacedGrasps

#: Number of a grasp's candidates refined (fine phase) and simulated at once: refinement costs half of a rollout.
TOGETHER: Final = 2
#: A refined hand with a merit above this has no rollout unless its grasp has no other candidate: of 176 such hands of
#: Allegro and Shadow 3 lifted at half friction.
HOPEFUL: Final = 0.3
#: A grasp with a score above this has failed: the object is lost, or the trajectory is blocked.
POOR: Final = 7.0
#: Share of the squeeze force in a second rollout of a hand that nearly holds at half friction. Of 144 hands of Shadow
#: .80 lift with the whole force, .83 with half, .92 with the best of six forces.
GENTLER: Final = 0.5
NEARLY: Final = 2.5
#: Score below which no further candidate of a free grasp is simulated, and the same in scenes. Below 1 an object holds
#: at half friction in short pushes. A limit of 0.5 instead of 1, with one retry above it, raises the share of grasps
#: that hold at half friction in the whole test: Shadow .70 to .76, Allegro .81 to .88, Barrett .83 to .92, at a tenth
#: more time.
GOOD: Final = 0.5
GOOD_IN_SCENES: Final = 0.995
#: Added to the merit of a hand in a scene with a finger that stands off the object, and its best score: worse than
#: that of any other hand that lifts at half friction.
STANDING_OFF: Final = 0.2
BEST_OFF: Final = 0.999
#: Score of candidates without a rollout.
HOPELESS: Final = 1e9


def with_postures(
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
    infeasible: NDArray[np.bool_]
    """Whether the depth or the number of touching links fails the geometric gate: such hands have no rollout."""
    off: NDArray[np.bool_]
    """Whether a finger stands off an object in a scene; such hands are simulated last and selected last."""


Seat = Callable[[NDArray[np.intp], NDArray[np.intp]], Refinements]

"""Runs the fine phase for some grasps (n,), given the rows (n, each) of their starts."""

RolloutOf = Callable[[GraspSet, NDArray[np.intp], Floats], Floats]
"""Scores (k,) grasps of the numbers (k,) against the scores to beat; see `worker.planners.Rollout`."""


@dataclass
class Selection:
    """Best candidate of each of n grasps so far; none where `score` is inf."""

    state: HandState
    losses: Floats
    score: Floats
    grasps: dict[int, GraspSet]

    @classmethod
    def none(cls, beat: Floats, dofs: int) -> Selection:
        """Return a selection without candidates; only scores below `beat` (n,) will count."""
        count = len(beat)
        empty = HandState(np.zeros((count, 3)), np.zeros((count, 4)), np.zeros((count, dofs)))
        return cls(empty, np.zeros(count), beat.copy(), {})

    def has(self, which: NDArray[np.intp]) -> NDArray[np.bool_]:
        return np.array([int(grasp) in self.grasps for grasp in which], bool)

    def take(
        self, found: GraspSet, refined: Refinements, rows: NDArray[np.intp], which: NDArray[np.intp], score: Floats
    ) -> None:
        """Store candidates `rows` (k,) of the grasps `which` (k,) where they are better, or the first ones."""
        state, losses = refined.state[rows], refined.losses[rows]
        for k in np.flatnonzero((score < self.score[which]) | ~self.has(which)):
            grasp = int(which[k])
            self.grasps[grasp] = found.take(slice(k, k + 1))
            self.score[grasp], self.losses[grasp] = min(score[k], self.score[grasp]), losses[k]
            for name in ("pivot", "rotation", "q"):
                getattr(self.state, name)[grasp] = getattr(state, name)[k]

    def joined(self) -> GraspSet:
        return joined([self.grasps[k] for k in range(len(self.score))])


def select_by_rollout(
    hand: HandModel,
    obj: ObjectModel,
    order: NDArray[np.intp],
    refine: Seat,
    placed: PlacedGrasps | None,
    rollout: RolloutOf,
    *,
    beat: Floats | None = None,
    together: int = TOGETHER,
    device: str = "cpu",
) -> Selection:
    """Return each grasp's first candidate with a good enough rollout, or else the one with the smallest score.
    `together` candidates of each grasp are refined and simulated in the order (n, each) of merit, then further ones for
    grasps without a good candidate. Unbalanced or infeasible hands have no rollout; a grasp's first hand is still used.
    Candidates that do not beat the scores `beat` (n,) of earlier attempts leave these scores unchanged."""
    good = GOOD if placed is None else GOOD_IN_SCENES
    beat = np.full(len(order), np.inf) if beat is None else beat
    taken, left = Selection.none(beat, hand.dofs), np.arange(len(order))
    for wave in np.split(order, range(together, order.shape[1], together), axis=1):
        if not len(left):
            break
        refined = refine(wave[left], left)
        for rows in rank_hands(refined.merit + STANDING_OFF * refined.off, len(left)).T:
            worth = (refined.merit[rows] < HOPEFUL) | (taken.score[left] > POOR)
            open_ = ~(taken.score[left] < good) & (worth & ~refined.infeasible[rows] | ~taken.has(left))
            if not open_.any():
                continue
            which = left[open_]
            where = placed.take(which) if placed is not None else None
            found = with_postures(
                hand, obj, refined.state[rows[open_]], refined.losses[rows[open_]], where, device=device
            )
            hopeless = refined.infeasible[rows[open_]] | ~worth[open_]
            score = _scores(found, hopeless, which, taken.score[which], rollout)
            _reduce_squeeze(hand, obj, found, score, which, rollout, device)
            score = np.where(refined.off[rows[open_]] & (score < BEST_OFF), BEST_OFF, score)
            taken.take(found, refined, rows[open_], which, score)
        left = left[~(taken.score[left] < good)]
    return taken


def _scores(
    found: GraspSet, infeasible: NDArray[np.bool_], which: NDArray[np.intp], beat: Floats, rollout: RolloutOf
) -> Floats:
    score, feasible = np.full(len(which), HOPELESS), np.flatnonzero(~infeasible)
    if len(feasible):
        score[feasible] = np.nan_to_num(
            rollout(found.take(feasible), which[feasible], beat[feasible]), nan=HOPELESS, posinf=HOPELESS
        )
    return score


def _reduce_squeeze(
    hand: HandModel,
    obj: ObjectModel,
    found: GraspSet,
    score: Floats,
    which: NDArray[np.intp],
    rollout: RolloutOf,
    device: str,
) -> None:
    """Use a smaller squeeze force for hands (k,) that nearly lift, if it improves the score.
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


#: Coulomb coefficient for the balance of contacts: lower than in any test, for a reserve.
FRICTION: Final = 0.3
#: The same in scenes: hands that balance at this friction mostly lift at half friction (AUC .80 of refined hands of
#: Allegro and Shadow whose merit is below .1; .74 with `FRICTION`).
SCENE_FRICTION: Final = 0.15
#: Weight of L_stable relative to the residual of the balance.
STABILITY: Final = 0.05
#: Weight of penetration [1/m] above the tolerance [m]: one more millimetre outweighs most of the residual.
DEPTH: Final = 200.0
TOLERATED_M: Final = 5e-4
#: Weight of the share of the hand's surface near a free object after the coarse phase, and the distance that counts as
#: near [m]. Among equally balanced hands, those that enclose more of the object are refined or simulated first.
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
    The merit sums the residual of contact forces balanced with `friction`, a share of L_stable (n,), and excess
    `depths` (n,) [m]."""
    holds = hold_forces(hand, obj, posture_of(hand, obj, state), friction=friction, device=device)
    merit = holds.residual + STABILITY * losses
    if depths is not None:
        merit += DEPTH * np.maximum(depths - TOLERATED_M, 0.0)
    return merit


def rank_hands(merit: Floats, grasps: int) -> NDArray[np.intp]:
    """Return rows (grasps, each) of each grasp's hands, the best first; hands of one grasp are adjacent."""
    each = merit.reshape(grasps, -1)
    # The stable sort keeps hands of equal merit in the order of their starts.
    return np.argsort(each, axis=1, kind="stable") + np.arange(grasps)[:, None] * each.shape[1]
