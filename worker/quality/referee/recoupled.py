"""The same hand with its tendons read otherwise: each joint with a drive of its own, or joints at a fixed ratio."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from service.model.transforms import Floats
from worker.hands.model import HandModel

Coupling = Literal["own", "compliant", "separate", "ratio"]


def recoupled(hand: HandModel, coupling: Coupling) -> HandModel:
    """The hand in another reading of its tendons; itself where it has none, or where the reading is of other things.

    separate: each joint of a tendon has the drive that it would have without. ratio: joints of a tendon turn as one,
    each by the same angle over its coefficient's sign, with the gain and the limit of all their drives together.
    """
    if not hand.tendons or coupling not in ("separate", "ratio"):
        return hand
    if coupling == "separate":
        return replace(hand, tendons=())
    leader = np.arange(hand.dofs)
    sign = np.ones(hand.dofs)
    for tendon in hand.tendons:
        leader[list(tendon.dofs)] = tendon.dofs[0]
        sign[list(tendon.dofs)] = np.sign(tendon.coefficients) * np.sign(tendon.coefficients[0])
    kept = np.unique(leader)
    drives = np.zeros((len(kept), hand.dofs))
    drives[np.searchsorted(kept, leader), np.arange(hand.dofs)] = sign
    ends = np.sort(np.stack([hand.lower, hand.upper]) * sign, axis=0)
    lower, upper = ends[0][kept].copy(), ends[1][kept].copy()
    for d, place in enumerate(np.searchsorted(kept, leader)):
        lower[place], upper[place] = max(lower[place], ends[0][d]), min(upper[place], ends[1][d])
    moved = hand.dof >= 0
    dof, rate = hand.dof.copy(), hand.multiplier.copy()
    dof[moved] = np.searchsorted(kept, leader[hand.dof[moved]])
    rate[moved] = hand.multiplier[moved] * sign[hand.dof[moved]]
    pulls = np.abs(drives)
    return replace(
        hand, tendons=(), dof=dof, multiplier=rate, dof_names=tuple(hand.dof_names[d] for d in kept), lower=lower,
        upper=upper, effort=pulls @ hand.effort, stiffness=pulls @ hand.stiffness, preshape=hand.preshape[kept],
        closing=hand.closing[kept], velocity=hand.velocity[kept] if len(hand.velocity) else hand.velocity,
    )  # fmt: skip


def nearest(hand: HandModel, joints: Floats) -> Floats:
    """Joint positions (N, J) that a hand of fewer dofs can take, nearest to those given."""
    dof, rate = hand.dof[hand.joint_body], hand.multiplier[hand.joint_body]
    drive = np.zeros((len(dof), hand.dofs))
    drive[np.arange(len(dof)), dof] = rate
    return hand.expand((joints - hand.offset[hand.joint_body]) @ np.linalg.pinv(drive).T)
