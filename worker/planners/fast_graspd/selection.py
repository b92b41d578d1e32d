"""Which of several hands makes the better grasp: how well its contacts balance, and how little the object moved."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from service.model.transforms import Floats, quat_rotate
from worker.grasps import Posture
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel
from worker.quality.postures import hold_forces
from worker.simulation.data import HandState

#: Coulomb coefficient with which contacts must balance: less than any test uses, so that what balances has a reserve.
FRICTION: Final = 0.3
#: The same in scenes: what balances with so little most often lifts at half the friction (AUC .80 of seated hands of
#: Allegro and Shadow whose merit is below .1; .74 with the other).
SCENE_FRICTION: Final = 0.15
#: Weight of L_stable against the residual of the balance.
STABILITY: Final = 0.05
#: Weight of penetration [1/m] above the tolerated [m]: a millimetre too deep outweighs most of an unbalanced grasp.
DEPTH: Final = 200.0
TOLERATED_M: Final = 5e-4
#: Weight of the share of the hand's surface that is at a free object after the coarse phase, and how near that is [m]:
#: of hands that balance alike the one that lies around more of the object goes on, or is tried first.
NEARNESS: Final = 2.0
NEAR_M: Final = 0.005


def posture_of(hand: HandModel, obj: ObjectModel, state: HandState) -> Posture:
    """The hands of a state in the object frame."""
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
    """(n,) the smaller the better: residual of contact forces balanced with a coefficient of `friction`, a little of
    L_stable (n,), and what the penetration `depths` (n,) [m] have above the tolerated."""
    holds = hold_forces(hand, obj, posture_of(hand, obj, state), friction=friction, device=device)
    merit = holds.residual + STABILITY * losses
    if depths is not None:
        merit += DEPTH * np.maximum(depths - TOLERATED_M, 0.0)
    return merit


def ranked(merit: Floats, grasps: int) -> NDArray[np.intp]:
    """(grasps, each) rows of the hands of each grasp, the best first; the hands of a grasp lie side by side."""
    each = merit.reshape(grasps, -1)
    # A stable sort: hands of equal merit are taken in the order in which they set out.
    return np.argsort(each, axis=1, kind="stable") + np.arange(grasps)[:, None] * each.shape[1]


def best_of_each(merit: Floats, grasps: int, keep: int) -> NDArray[np.intp]:
    """Rows of the `keep` best hands of each grasp, in the order in which they set out."""
    return np.sort(ranked(merit, grasps)[:, :keep], axis=1).ravel()
