"""How far hands must rise until they are clear of what stands around, told by a few points of their outline: cheap
enough for many more hands than are looked at exactly."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Final

import numpy as np
from cachetools import LRUCache
from numpy.typing import NDArray

from service.model.transforms import IDENTITY_POSE, Floats, apply, spread_directions
from worker.hands.kinematics import body_poses
from worker.hands.model import HandModel
from worker.hands.oppositions import Oppositions
from worker.simulation.mounting import OUTERMOST, points_of
from worker.simulation.obstacles import MARGIN_M
from worker.simulation.surroundings import Surroundings

#: Directions in which a hand's outermost points are taken, of its fingertips and of the rest of it.
DIRECTIONS: Final = 20


@dataclass(frozen=True)
class Outlines:
    """Outermost points of a hand in each of its K opposed postures, from the palm's centre."""

    points: Floats
    """(K, P, 3) [m]"""
    tips: NDArray[np.bool_]
    """(P,) those of fingertips."""
    mounting: Floats
    """(W, M, 3) outermost points of the mounting at each of its wrist positions, from the palm's centre [m]; W is 0
    without one."""

    def lacks(
        self, posture: NDArray[np.intp], turn: Floats, centre: Floats, scene: Surroundings, *, room: float
    ) -> Floats:
        """(n,) what hands and their mountings lack of the distance from obstacles that they are to keep, and of `room`
        besides [m]; 0 or more.

        Args:
            posture: (n,) which of the K.
            turn: (n, 3, 3) rotations.
            centre: (n, 3) centres of the palms, object frame [m].
            scene: the obstacles.
            room: [m]
        """
        place = np.matmul(self.points[posture], np.swapaxes(turn, -1, -2)) + centre[:, None]
        lack = np.zeros(len(posture))
        for obstacle in scene.obstacles:
            wanted = np.where(self.tips, MARGIN_M if obstacle.tips_m is None else obstacle.tips_m, MARGIN_M) + room
            lack = np.maximum(lack, (wanted - obstacle.distance(place)).max(axis=1))
        return np.maximum(lack, self._mounting_lacks(turn, centre, scene, MARGIN_M + room))

    def _mounting_lacks(self, turn: Floats, centre: Floats, scene: Surroundings, wanted: float) -> Floats:
        """(n,) what mountings at the best of their wrist positions lack of the distance `wanted` from obstacles [m]."""
        least = np.full(len(turn), np.inf if len(self.mounting) else 0.0)
        for points in self.mounting:
            rows = np.flatnonzero(least > 0.0)
            place = points @ np.swapaxes(turn[rows], -1, -2) + centre[rows, None]
            lack = [(wanted - obstacle.distance(place)).max(axis=1) for obstacle in scene.obstacles]
            least[rows] = np.minimum(least[rows], np.maximum.reduce([*lack, np.zeros(len(rows))]))
        return least


_known: LRUCache[tuple[str, bytes], Outlines] = LRUCache(16)
_lock = threading.Lock()


def outlines_of(hand: HandModel, postures: Oppositions) -> Outlines:
    """The outlines of opposed postures of a hand, from memory where they are known."""
    key = (hand.content, postures.q.tobytes())
    with _lock:
        if key not in _known:
            _known[key] = _outlines(hand, postures.q)
        return _known[key]


def _outlines(hand: HandModel, q: Floats) -> Outlines:
    bodies = body_poses(hand, np.tile(IDENTITY_POSE, (len(q), 1)), hand.expand(q))
    points, tips = [], []
    for tip in (True, False):
        solid = [apply(bodies[:, p.body, None], p.vertices) for p in hand.pieces if (p.body in hand.fingertips) == tip]
        if solid:
            corners = np.concatenate(solid, axis=1)
            far = (corners @ spread_directions(DIRECTIONS).T).argmax(axis=1)
            points.append(np.take_along_axis(corners, far[..., None], axis=1))
            tips.append(np.full(DIRECTIONS, tip))
    mounting = np.zeros((0, 0, 3))
    if hand.mounting is not None:
        mounting = points_of(hand.mounting)[:, :OUTERMOST] - hand.palm.centre
    return Outlines(np.concatenate(points, axis=1) - hand.palm.centre, np.concatenate(tips), mounting)
