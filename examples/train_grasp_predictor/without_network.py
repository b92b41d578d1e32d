"""What a network must beat: hands across what is seen, and the grasps of the most similar picture."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from examples.train_grasp_predictor.execution import tighter, wider
from examples.train_grasp_predictor.samples import Floats, Sight, TrainedModel, each_scene
from graspd.baselines.learned.network import Proposals, decode
from graspd.service.model.transforms import quat_from_matrix, quat_rotate
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.pinch_postures import oppositions_of
from graspd.worker.simulation.environment import UP

#: Draws for each hand that is kept, and the farthest that a hand leans from straight down [rad].
DRAWS: Final = 8
LEANS: Final = np.deg2rad(20.0)
#: By how much closing joints press beyond contact [rad]: of 0.1, 0.2 and 0.4 what lifts most of objects trained on.
SQUEEZE: Final = 0.1
#: Share of their range by which fingers are open before they close.
_OPEN: Final = 0.15
#: Share of points beyond which an extent does not count them: a depth camera's edges bleed.
_OUTSIDE: Final = 0.02
#: How far below the top of what is seen pads take hold at most [m].
BELOW_TOP_M: Final = 0.03
#: Turns about the vertical and points by which pictures are compared.
TURNS: Final = 16
COMPARED: Final = 64


def across(hand: HandModel, sight: Sight, count: int, *, squeeze: float, rng: np.random.Generator) -> Proposals:
    """Hands from above with opposed fingers across what is seen: of random directions those in which it is narrow.

    Args:
        hand: a hand whose fingers oppose one another.
        sight: the picture.
        count: N.
        squeeze: by how much closing joints press beyond contact [rad].
        rng: draws directions.
    """
    known, n = oppositions_of(hand), DRAWS * count
    turn, lean = rng.uniform(0, 2 * np.pi, n), rng.uniform(-LEANS, LEANS, n)
    axis = np.stack([np.cos(turn), np.sin(turn), np.zeros(n)], axis=1)
    along = (sight.points - sight.anchor) @ axis.T
    low, high = np.quantile(along, [_OUTSIDE, 1 - _OUTSIDE], axis=0)
    posture = np.abs(known.width[:, None] - (high - low)).argmin(axis=0)
    order = np.argsort(high - low + 10.0 * np.maximum(0.0, high - low - known.widest), kind="stable")[:count]
    axis, lean, posture = axis[order], lean[order], posture[order]
    middle = sight.anchor + (0.5 * (low + high))[order, None] * axis
    middle[:, 2] = np.maximum(middle[:, 2], np.quantile(sight.points[:, 2], 1 - _OUTSIDE) - BELOW_TOP_M)
    down = np.cos(lean)[:, None] * np.array([0.0, 0.0, -1.0]) + np.sin(lean)[:, None] * np.cross(axis, UP)
    own = _frame(known.axis[posture], np.broadcast_to(hand.palm.approach, axis.shape))
    rotation = quat_from_matrix(_frame(axis, down) @ np.swapaxes(own, 1, 2))
    pose = np.concatenate([middle - quat_rotate(rotation, known.middle[posture]), rotation], axis=1)
    grasp = hand.expand(known.q[posture])
    return Proposals(
        pose, quat_rotate(rotation, hand.palm.approach), grasp, wider(hand, grasp, _OPEN), tighter(hand, grasp, squeeze)
    )


def _frame(x: Floats, towards: Floats) -> Floats:
    """(N, 3, 3) rotations with first columns `x` (N, 3), unit, and third ones as near to `towards` (N, 3) as may be."""
    z = towards - (towards * x).sum(axis=1, keepdims=True) * x
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=-1)


class Nearest:
    """The grasps of the picture that looks most alike after a turn about the vertical."""

    def __init__(self, seen: Sequence[Sight], taught: Sequence[TrainedModel]) -> None:
        """
        Args:
            seen: pictures; those whose scene has grasps are kept.
            taught: the grasps.
        """
        self._rows = {scene: part.rows[which] for part in taught for scene, which in each_scene(part)}
        self._seen = [sight for sight in seen if sight.scene in self._rows]
        self._trees = [cKDTree(self._shape(sight)) for sight in self._seen]
        self._shapes = [self._shape(sight) for sight in self._seen]

    @staticmethod
    def _shape(sight: Sight) -> Floats:
        """(C, 3) some points, counted from the anchor's foot on the table."""
        return np.asarray(sight.points[:COMPARED] - [*sight.anchor[:2], 0.0])

    def propose(self, sight: Sight, count: int, rng: np.random.Generator) -> Proposals:
        """The grasps of the most similar pictures, the best first, where theirs would lie here."""
        shape = self._shape(sight)
        angles = 2 * np.pi * np.arange(TURNS) / TURNS
        turns = np.stack([_turned(shape, -angle) for angle in angles])
        mine = [cKDTree(turn) for turn in turns]
        there = np.array([_gaps(tree, turns).mean(axis=1) for tree in self._trees])
        coarse = np.argsort(there.min(axis=1), kind="stable")[:20]
        back = np.array([[_gaps(tree, self._shapes[k]).mean() for tree in mine] for k in coarse])
        cost = there[coarse] + back
        found: list[Floats] = []
        for best in np.argsort(cost.min(axis=1), kind="stable"):
            angle, other = angles[int(cost[best].argmin())], self._seen[coarse[best]]
            rows = self._rows[other.scene].copy()
            rows = rows[rng.permutation(len(rows))]
            foot = np.array([*other.anchor[:2], 0.0])
            rows[:, :3] -= foot
            vectors = _turned(rows[:, :12].reshape(len(rows), 4, 3), float(angle))
            rows[:, :12] = vectors.reshape(len(rows), 12)
            rows[:, :3] += [*sight.anchor[:2], 0.0]
            found.append(rows)
            if sum(map(len, found)) >= count:
                break
        return decode(np.concatenate(found)[:count], np.zeros(3))


def _gaps(tree: cKDTree, points: Floats) -> Floats:
    """(...) distances of points (..., 3) from the nearest of a tree."""
    return np.asarray(tree.query(points)[0])


def _turned(vectors: Floats, angle: float) -> Floats:
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray(vectors @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]]))
