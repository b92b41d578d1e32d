"""Gains and limits of joints for which nobody states any, where the unit of a revolute joint would be absurd."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from worker.hands.jaws import jaws_of, slides
from worker.hands.model import HandModel
from worker.hands.options import DEFAULT_FORCE, DEFAULT_LINEAR_STIFFNESS


def with_drive(hand: HandModel, stated: Collection[str], assumed: Sequence[str]) -> HandModel:
    """The hand with the defaults of sliding joints and of jaws instead of those of revolute joints.

    A dof that moves pads by v [m/rad or 1] along their line gets the gain k v^2, summed over the pads, and the limit
    f v: at each pad that is k [N/m] and f [N], however the dof is geared to it.

    Args:
        hand: the hand with its palm and closing.
        stated: dofs whose position gain somebody states: it stays.
        assumed: dofs whose limit of torque or force nobody states.
    """
    slide, jaws = slides(hand), jaws_of(hand)
    if jaws is None and not slide.any():
        return hand
    gain = np.where(slide, DEFAULT_LINEAR_STIFFNESS, hand.stiffness)
    limit = np.where(slide, DEFAULT_FORCE, hand.effort)
    if jaws is not None:
        half = jaws.speed[len(jaws.speed) // 2]
        moves = np.abs(half).sum(axis=1) > 0
        gain = np.where(moves, DEFAULT_LINEAR_STIFFNESS * (half**2).sum(axis=1), gain)
        limit = np.where(moves, DEFAULT_FORCE * np.abs(half).sum(axis=1), limit)
    keeps = np.array([dof in stated for dof in hand.dof_names])
    free = np.array([dof in assumed for dof in hand.dof_names])
    return replace(hand, stiffness=np.where(keeps, hand.stiffness, gain), effort=np.where(free, limit, hand.effort))
