"""Selection of proposals with the best evaluator scores, and refinement by random perturbations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike
from torch import nn

from examples.train_grasp_predictor.evaluation import Proposer
from examples.train_grasp_predictor.evaluator import scores
from examples.train_grasp_predictor.execution import made_ready, part_of
from examples.train_grasp_predictor.samples import Floats, Sight
from graspd.baselines.learned.network import Proposals
from graspd.service.model.transforms import quat_from_axis_angle, quat_multiply, quat_rotate
from graspd.worker.hands.model import HandModel

#: Standard deviations of a perturbation of size 1: position [m], rotation [rad], each joint [rad or m], all closing
#: joints together, and all closing joints in the squeeze only, because too weak and too strong a squeeze fail.
PLACE_M, TURN, JOINT, CLOSING, SQUEEZE = 0.008, 0.1, 0.05, 0.05, 0.05
#: Size of perturbations in each round; hands kept per round, and perturbations per kept hand.
ROUNDS: Final = (1.0, 0.7, 0.5, 0.4)
KEPT, MOVES = 12, 4
#: Penalty of hands that are not clear of the table and the camera's points [logit].
_BLOCKED: Final = 4.0
#: Hands whose root links are at most this far apart count as the same proposal [m].
APART_M: Final = 0.01

#: Initial proposals per picture: 32 lifted fewer unseen faces, and 256 lifted no more.
BEGUN: Final = 96


@dataclass(frozen=True)
class RefinedHands:
    """`Proposer` of hands selected and refined by an evaluator."""

    hand: HandModel
    evaluator: nn.Module
    """An `Evaluator` or an `Ensemble`."""
    source: Proposer
    rounds: tuple[float, ...] = ROUNDS
    begun: int = BEGUN

    def __call__(self, sight: Sight, count: int, rng: np.random.Generator) -> Proposals:
        """Return `count` hands, the best first."""
        hands, values = self._scored(self.source(sight, self.begun, rng), sight)
        for size in self.rounds:
            best = np.argsort(-values, kind="stable")[:KEPT]
            hands, values = part_of(hands, best), values[best]
            parents = part_of(hands, np.repeat(np.arange(len(best)), MOVES))
            changed, worth = self._scored(moved(self.hand, parents, size, rng), sight)
            hands, values = joined(hands, changed), np.concatenate([values, worth])
        return part_of(hands, _apart(hands, np.argsort(-values, kind="stable"), count))

    def _scored(self, hands: Proposals, sight: Sight) -> tuple[Proposals, Floats]:
        """Return hands ready for execution, and their scores."""
        ready = made_ready(self.hand, hands, sight)
        return ready.hands, scores(self.evaluator, self.hand, sight, ready.hands) - _BLOCKED * ~ready.clear


def moved(hand: HandModel, hands: Proposals, size: ArrayLike, rng: np.random.Generator) -> Proposals:
    """Perturb N hands at random; `size` is () or (N,)."""
    n = len(hands)
    by = np.broadcast_to(size, (n,))[:, None]
    turn = TURN * by * rng.standard_normal((n, 3))
    angle = np.linalg.norm(turn, axis=1)
    rotation = quat_from_axis_angle(turn / np.maximum(angle, 1e-12)[:, None], angle)
    pose = hands.hand_pose.copy()
    pose[:, :3] += PLACE_M * by * rng.standard_normal((n, 3))
    pose[:, 3:] = quat_multiply(rotation, pose[:, 3:])
    own = JOINT * by * rng.standard_normal(hands.joints.shape)
    closing = CLOSING * by * rng.standard_normal((n, 1)) * hand.closing
    harder = closing + SQUEEZE * by * rng.standard_normal((n, 1)) * hand.closing
    joints = (
        np.asarray(hand.expand(np.clip(hand.reduce(part + own) + more, hand.lower, hand.upper)))
        for part, more in ((hands.joints, closing), (hands.pregrasp, closing), (hands.squeeze, harder))
    )
    return Proposals(pose, quat_rotate(rotation, hands.approach), *joints)


def joined(*parts: Proposals) -> Proposals:
    """Concatenate proposals."""
    return Proposals(*(np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0])))


def _apart(hands: Proposals, order: np.ndarray, count: int) -> np.ndarray:
    """Return the first hands of `order` with distinct positions; if these are too few, also others."""
    chosen: list[int] = []
    for index in order:
        gaps = np.linalg.norm(hands.hand_pose[chosen, :3] - hands.hand_pose[index, :3], axis=1)
        if len(chosen) < count and (gaps > APART_M).all():
            chosen.append(int(index))
    others = [int(index) for index in order if index not in chosen]
    return np.array((chosen + others)[:count], np.intp)
