"""From what the network answers to grasps: as proposed, carried out, and a control without a network.

A proposal says where the hand goes and how it is shaped. It is carried out as a robot with touch would: the fingers
open, the hand backs off as far as it must to touch nothing, advances until it nearly touches, and the fingers close
until contact. All sources of data are treated alike. The control needs no network: hands that look at the object from
anywhere advance and close in the same way, which is the method `autograsp`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from examples.train_grasp_predictor.network import Predictor
from examples.train_grasp_predictor.samples import Example
from service.model.transforms import compose, invert, quat_from_matrix, quat_rotate
from worker.grasps import GraspSet
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel
from worker.planners.autograsp import kernels
from worker.planners.autograsp.closing import Closer
from worker.planners.fast_graspd.pairs import Pair
from worker.planners.peers import free_starts, grasp_set, ground_of
from worker.simulation.state import HandState

Floats = NDArray[np.float64]

#: Proposals of a picture that are carried out: those of the highest scores.
TAKEN: Final = 4
#: Shares of the way from the proposed joints to the pre-shape that the fingers open; the first that is enough counts.
OPENINGS: Final = (0.5, 1.0)
#: Distances the hand backs off, of which the first that is clear is taken [m].
BACK_M: Final = tuple(0.005 * k for k in range(41))
CLEAR_M: Final = 0.001
STANDOFF_M: Final = 0.005


def proposals(network: Predictor, pictures: Sequence[Example]) -> tuple[Floats, Floats]:
    """Hand poses (N, 7) in the object's frame and joints (N, J) of the best proposals for each picture."""
    with torch.no_grad():
        grasps, logits = network(torch.stack([picture.image for picture in pictures]))
    best = logits.argsort(dim=1, descending=True)[:, :TAKEN]
    poses, joints = [], []
    for picture, rows, chosen in zip(pictures, grasps.numpy().astype(float), best.numpy(), strict=True):
        for row in rows[chosen]:
            poses.append(in_object_frame(row, picture))
            joints.append(row[9:])
    return np.array(poses), np.array(joints)


def in_object_frame(row: Floats, picture: Example) -> Floats:
    """(7,) hand pose of an answer (9 + J,) of the network: the inverse of `samples.targets_of`."""
    hand = np.concatenate([row[:3] + picture.anchor, quat_from_matrix(orthogonal(row[3:9]))])
    return compose(invert(picture.object_pose), hand)


def orthogonal(columns: Floats) -> Floats:
    """(3, 3) rotation from its first two columns (6,), the first one kept."""
    x = columns[:3] / max(float(np.linalg.norm(columns[:3])), 1e-9)
    y = columns[3:] - (columns[3:] @ x) * x
    y = y / max(float(np.linalg.norm(y)), 1e-9)
    return np.stack([x, y, np.cross(x, y)], axis=1)


def as_proposed(hand: HandModel, obj: ObjectModel, poses: Floats, joints: Floats) -> GraspSet:
    """Proposals untouched: hand poses (N, 7) in the object's frame, joints (N, J)."""
    return grasp_set(ground_of(hand, obj, "cpu", kernels), _state(hand, obj, poses, joints), 0.0, {})


def carried_out(hand: HandModel, obj: ObjectModel, poses: Floats, joints: Floats) -> GraspSet:
    """Proposals after opening, backing off until clear, advancing and closing."""
    pair = ground_of(hand, obj, "cpu", kernels)
    return _advanced(pair, _clear(pair, _state(hand, obj, poses, joints)))


def _state(hand: HandModel, obj: ObjectModel, poses: Floats, joints: Floats) -> HandState:
    q = np.clip(hand.reduce(joints), hand.lower, hand.upper)
    rotation = poses[:, 3:]
    pivot = poses[:, :3] - obj.centre_of_mass + quat_rotate(rotation, hand.palm.centre)
    return HandState(pivot, rotation, q)


def anywhere(hand: HandModel, obj: ObjectModel, count: int, seed: int) -> GraspSet:
    """The control: hands that look at a random place of the object, carried out in the same way."""
    pair = ground_of(hand, obj, "cpu", kernels)
    return _advanced(pair, free_starts(pair, seed=seed, batch=0, indices=range(count)))


def _clear(pair: Pair, state: HandState) -> HandState:
    """Each hand opened and backed off by the least that makes it clear of the object, else as far as may be."""
    closer, hand = Closer(pair, len(state.pivot)), pair.hand.model
    back, closes = -quat_rotate(state.rotation, hand.palm.approach), hand.closing != 0
    opening = np.where(closes, hand.preshape - state.q, 0.0)
    free, settled = state, np.zeros(len(state.pivot), bool)
    for distance, share in ((distance, share) for distance in BACK_M for share in OPENINGS):
        moved = HandState(state.pivot + distance * back, state.rotation, state.q + share * opening)
        now = settled | (closer.distances(moved).min(axis=1) > CLEAR_M)
        keep = settled[:, None]
        pivot, q = np.where(keep, free.pivot, moved.pivot), np.where(keep, free.q, moved.q)
        free, settled = HandState(pivot, state.rotation, q), now
    return free


def _advanced(pair: Pair, state: HandState) -> GraspSet:
    closer = Closer(pair, len(state.pivot))
    return grasp_set(pair, closer.close(closer.approach(state, STANDOFF_M)).state, 0.0, {})
