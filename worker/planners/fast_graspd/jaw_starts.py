"""Starts of grippers: the object between the open jaws, pads along its opposite sides.

A pair of opposite surface points is drawn, the jaws are opened a little wider than it is and put around it, turned by a
random angle about the line that joins the points.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from service.model.transforms import Floats, quat_from_matrix, quat_rotate
from worker.hands.jaws import Jaws, jaws_of
from worker.hands.model import HandModel
from worker.objects.antipodal import Pairs
from worker.objects.model import ObjectModel
from worker.planners.fitting import fitting_pairs
from worker.simulation.data import HandState

#: Room between each pad and the object [m]: least and most.
ROOM_M: Final = (0.002, 0.005)
#: How far ahead of the middle of the pads the object's place may lie, as a share of their length; then how much farther
#: the hand stays back while something touches.
AHEAD: Final = (-0.25, 0.25)
RETREATS: Final = (0.0, 0.25, 0.5, 0.75)
#: Shortest and longest length of pads that this is a share of [m].
LENGTH_M: Final = (0.01, 0.05)
#: Uniform numbers of one draw: pair, side, angle, room, place.
UNIFORM: Final = 5
#: A line farther from the centre of mass than this share of the object's radius is drawn exp(-1/2) times as often.
CENTRAL: Final = 0.35


@dataclass(frozen=True)
class JawStarts:
    """What draws for a gripper and an object share."""

    hand: HandModel
    obj: ObjectModel
    jaws: Jaws
    pairs: Pairs
    sums: Floats
    """(P,) cumulative shares with which pairs are drawn."""

    @classmethod
    def of(cls, hand: HandModel, obj: ObjectModel) -> JawStarts | None:
        """None where the hand is no gripper.

        Raises:
            InputError: the object does not fit between the jaws.
        """
        jaws, pairs = jaws_of(hand), fitting_pairs(hand, obj)
        if jaws is None or pairs is None:
            return None
        way = (pairs.end - pairs.start) / pairs.width[:, None]
        aside = np.linalg.norm(np.cross(pairs.start - obj.centre_of_mass, way), axis=1)
        weight = np.exp(-0.5 * (aside / (CENTRAL * obj.radius)) ** 2) + 1e-3
        return cls(hand, obj, jaws, pairs, np.cumsum(weight) / weight.sum())

    def draw(self, uniform: Floats) -> HandState:
        """Hands of random numbers (n, `UNIFORM`) in [0, 1), each at each retreat: n * len(RETREATS) of them."""
        pick = np.minimum(np.searchsorted(self.sums, uniform[:, 0]), len(self.sums) - 1)
        start, end = self.pairs.start[pick], self.pairs.end[pick]
        swap = (uniform[:, 1] < 0.5)[:, None]
        start, end = np.where(swap, end, start), np.where(swap, start, end)
        room = ROOM_M[0] + (ROOM_M[1] - ROOM_M[0]) * uniform[:, 3]
        q, middle, axis = self.jaws.at(np.minimum(self.pairs.width[pick] + 2 * room, self.jaws.opening))
        line = (end - start) / self.pairs.width[pick][:, None]
        ahead = _across(line, uniform[:, 2])
        own = _frames(axis, np.tile(self.hand.palm.approach, (len(q), 1)))
        rotation = quat_from_matrix(_frames(line, ahead) @ own.transpose(0, 2, 1))
        length = float(np.clip(self.jaws.length, *LENGTH_M))
        place = (AHEAD[0] + (AHEAD[1] - AHEAD[0]) * uniform[:, 4])[:, None] + np.array(RETREATS)[None]
        at = ((start + end) / 2)[:, None] - length * place[..., None] * ahead[:, None]
        pivot = at - self.obj.centre_of_mass + quat_rotate(rotation, self.hand.palm.centre - middle)[:, None]
        each = len(RETREATS)
        return HandState(pivot.reshape(-1, 3), np.repeat(rotation, each, axis=0), np.repeat(q, each, axis=0))


def _across(line: Floats, turn: Floats) -> Floats:
    """(n, 3) unit vectors across lines (n, 3), turned by shares (n,) of a full turn."""
    helper = np.eye(3)[np.argmin(np.abs(line), axis=1)]
    x = np.cross(line, helper)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    angle = 2 * np.pi * turn[:, None]
    return np.asarray(np.cos(angle) * x + np.sin(angle) * np.cross(line, x))


def _frames(x: Floats, z: Floats) -> Floats:
    """(n, 3, 3) rotation matrices with first columns x (n, 3) and third columns as near to z (n, 3) as can be."""
    z = z - np.einsum("ni,ni->n", z, x)[:, None] * x
    z = z / np.linalg.norm(z, axis=1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=-1)
