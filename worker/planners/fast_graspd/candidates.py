"""Candidates of a grasp in its scene, tried one after another in the order of their merit until one is good enough."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from worker.grasps import GraspSet, joined
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel
from worker.planners.fast_graspd.selection import posture_of
from worker.planners.port import Trial
from worker.quality.postures import pregrasp, squeeze
from worker.simulation.state import HandState
from worker.simulation.surroundings import Placed

Floats = NDArray[np.float64]


def with_postures(
    hand: HandModel, obj: ObjectModel, state: HandState, losses: Floats, placed: Placed | None
) -> GraspSet:
    """Hands (n) as grasps with the postures around them."""
    grasp = posture_of(hand, obj, state)
    return GraspSet(grasp, pregrasp(hand, obj, grasp, placed), squeeze(hand, obj, grasp), losses)


def tried(
    hand: HandModel,
    obj: ObjectModel,
    state: HandState,
    losses: Floats,
    order: NDArray[np.intp],
    placed: Placed,
    trial: Trial,
) -> tuple[NDArray[np.intp], GraspSet]:
    """Of the hands of each grasp the first that the trial finds good enough, or else the one with the least score.

    Args:
        hand: the hand.
        obj: the object.
        state: all hands.
        losses: L_stable of each.
        order: (n, each) rows of the hands of each grasp, the first to be tried first.
        placed: scenes of the n grasps.
        trial: gives the scores.

    Returns:
        Rows (n,) of the hands that were taken, and their grasps.
    """
    count = len(order)
    least, taken = np.full(count, np.inf), np.array(order[:, 0])
    kept: dict[int, GraspSet] = {}
    left = np.arange(count)
    for rows in order.T:
        found = with_postures(hand, obj, state[rows[left]], losses[rows[left]], placed.take(left))
        score = trial(found, placed.take(left))
        for k in np.flatnonzero(score < least[left]):
            grasp = int(left[k])
            kept[grasp], least[grasp], taken[grasp] = found.take(slice(k, k + 1)), score[k], rows[grasp]
        left = left[~(least[left] < 1.0)]
        if not len(left):
            break
    return taken, joined([kept[grasp] for grasp in range(count)])
