"""Two eigengrasps of any hand, after those that GraspIt! ships.

GraspIt! has eigengrasps for Barrett (spread; all fingers) and the human hand (flexion of the knuckles with a little of
the joints beyond; the knuckles against the joints beyond), none for Allegro or Shadow. Here a hand whose fingers have
one closing dof each gets Barrett's, any other the human hand's, by a joint's place along its finger.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from service.model.transforms import Floats
from worker.hands.kinematics import ancestors
from worker.hands.model import HandModel

#: Weights of a finger's first, second and later closing joints in the human hand's eigengrasps.
FLEXION: Final = (1.0, 0.3, 0.15)
SECOND: Final = (-1.0, 1.0, 0.3)
#: Where closing joints stand in the mean posture, as a share of their range (Barrett's origin: 0.79 of 2.44 rad).
ORIGIN: Final = 0.33
#: Largest amplitude.
AMPLITUDE: Final = 4.0


@dataclass(frozen=True)
class Eigengrasps:
    """Postures q = origin + amplitudes @ directions, inside the joint limits."""

    origin: Floats
    """(D,)"""
    directions: Floats
    """(2, D)"""
    limits: Floats
    """(2, 2) least and largest amplitude of each: beyond them no joint moves any more."""

    def posture(self, amplitudes: Floats, hand: HandModel) -> Floats:
        """(n, D) for amplitudes (n, 2)."""
        return np.clip(self.origin + np.asarray(amplitudes) @ self.directions, hand.lower, hand.upper)


def places(hand: HandModel) -> NDArray[np.int32]:
    """(D,) how many closing dofs stand between a closing dof and the palm; -1 for dofs that do not close."""
    moved = ancestors(hand)
    first = [int(np.flatnonzero(hand.dof == d)[0]) for d in range(hand.dofs)]
    out = np.full(hand.dofs, -1, np.int32)
    for d, body in enumerate(first):
        if hand.closing[d]:
            before = {int(hand.dof[k]) for k in np.flatnonzero(moved[body]) if k > 0} - {d}
            out[d] = sum(hand.closing[e] != 0 for e in before)
    return out


def eigengrasps(hand: HandModel) -> Eigengrasps:
    """The two eigengrasps of a hand."""
    place, closing = places(hand), np.asarray(hand.closing, float)
    closes = closing != 0
    if place.max() <= 0:
        directions = np.array([(~closes).astype(float), closing])
        if not directions[0].any():  # no spread: the first eigengrasp would be empty
            directions[0] = closing * np.where(np.arange(hand.dofs) % 2, -1.0, 1.0)
    else:
        row = np.clip(place, 0, 2)
        directions = np.array([closing * np.array(weights)[row] * closes for weights in (FLEXION, SECOND)])
    opened, span = np.where(closing >= 0, hand.lower, hand.upper), hand.upper - hand.lower
    origin = np.where(closes, opened + ORIGIN * span * np.where(closing >= 0, 1, -1), (hand.lower + hand.upper) / 2)
    limits = np.zeros((2, 2))
    for i, direction in enumerate(directions):
        moving = direction != 0
        ends = np.stack([hand.lower - origin, hand.upper - origin])[:, moving] / direction[moving]
        limits[i] = np.clip([ends.min(), ends.max()], -AMPLITUDE, AMPLITUDE)
    return Eigengrasps(origin, directions, limits)
