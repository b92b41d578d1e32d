"""Controls without a network: pinches across visible points, and grasps of the most similar picture."""

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
from graspd.worker.hands.pinch_postures import pinch_postures_of
from graspd.worker.simulation.environment import UP

#: Random draws per returned hand, and largest angle between hand and vertical [rad].
DRAWS: Final = 8
LEANS: Final = np.deg2rad(20.0)
#: Angle by which joints close beyond contact [rad]: the best of 0.1, 0.2 and 0.4 on training objects.
SQUEEZE: Final = 0.1
#: Opening of the fingers before closing, as a share of their range.
_OPEN: Final = 0.15
#: Share of points ignored at each end of an extent, because edges in depth pictures are blurred.
_OUTSIDE: Final = 0.02
#: Largest depth of the fingertips below the top of the visible points [m].
BELOW_TOP_M: Final = 0.03
#: Rotations about the vertical, and points, in comparisons of pictures.
TURNS: Final = 16
COMPARED: Final = 64


def across(hand: HandModel, sight: Sight, count: int, *, squeeze: float, rng: np.random.Generator) -> Proposals:
    """Return pinches from above across the visible points, in the narrowest of random directions.

    Args:
        hand: a hand whose fingers oppose one another.
        sight: the picture.
        count: number of hands.
        squeeze: angle by which joints close beyond contact [rad].
        rng: generator of directions.
    """
    known, n = pinch_postures_of(hand), DRAWS * count
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
    """Return rotations (N, 3, 3): first column `x` (N, 3), unit; third column nearest to `towards` (N, 3)."""
    z = towards - (towards * x).sum(axis=1, keepdims=True) * x
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=-1)


class Nearest:
    """Proposer of the grasps of the most similar picture, up to rotations about the vertical."""

    def __init__(self, seen: Sequence[Sight], taught: Sequence[TrainedModel]) -> None:
        """
        Args:
            seen: pictures; only those of scenes with grasps are used.
            taught: grasps of each object.
        """
        self._rows = {scene: part.rows[which] for part in taught for scene, which in each_scene(part)}
        self._seen = [sight for sight in seen if sight.scene in self._rows]
        self._trees = [cKDTree(self._shape(sight)) for sight in self._seen]
        self._shapes = [self._shape(sight) for sight in self._seen]

    @staticmethod
    def _shape(sight: Sight) -> Floats:
        """Return some points (C, 3) relative to the table point below the anchor."""
        return np.asarray(sight.points[:COMPARED] - [*sight.anchor[:2], 0.0])

    def propose(self, sight: Sight, count: int, rng: np.random.Generator) -> Proposals:
        """Return the grasps of the most similar pictures, moved to this object; the best picture is first."""
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
    """Return the distances (...) of points (..., 3) from the nearest point of a tree."""
    return np.asarray(tree.query(points)[0])


def _turned(vectors: Floats, angle: float) -> Floats:
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray(vectors @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]]))
