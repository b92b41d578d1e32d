"""Closing direction of each joint from the motion of its fingertips; joint limits break ties."""

from typing import Final

import numpy as np

from graspd.service.model.transforms import IDENTITY_POSE, Floats, apply, quat_rotate
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.model import HandModel

#: Ratio of a joint's two limits above which they are asymmetric: 2, less a tolerance for rounded limits.
FAR: Final = 1.99
#: Shares of the range from open to closed at which fingertips are evaluated.
_SHARES: Final = (0.25, 0.5, 0.75)
#: Least cosine at which two joint axes count as parallel (45 degrees), and at which an axis and the approach do (37).
_PARALLEL: Final = 0.707
_ABOUT: Final = 0.8
#: A joint moves the tip if its tip motion exceeds this share of the largest tip motion by a joint of the finger.
_MOVING: Final = 0.05
#: Limits are symmetric if their middle is within this share of the range from 0. Such joints stay straight.
_EVEN: Final = 0.02
#: Gains below this share of the tip's path length are a tie. Joints that oppose a thumb have .35 and more.
_TIE: Final = 0.2


def closing_by_limits(hand: HandModel) -> Floats:
    """Return closing (D,): the sign of the larger limit if limits are asymmetric, else 0; 0 for wrists."""
    up, down = np.maximum(hand.upper, 0), np.maximum(-hand.lower, 0)
    closing = np.where(up > FAR * down, 1.0, np.where(down > FAR * up, -1.0, 0.0))
    carrying = set(shared_bodies(hand))
    for body, name in zip(hand.joint_body, hand.joint_names, strict=True):
        if body in carrying and name in hand.dof_names:
            closing[hand.dof_names.index(name)] = 0.0
    return closing


def closing_by_tips(hand: HandModel) -> Floats:
    """Return closing (D,) in -1, 0, +1 for a hand with fingertips, palm and a first guess of its closing.
    Joints parallel to a finger's last joint flex the finger, unless their limits are symmetric. They close in the
    direction that brings the tip to the other tips and to the palm. Other joints close if they bring the tip to the
    other tips and ahead, unless they turn about the approach or have symmetric limits."""
    limits, (flexing, opposing, ways) = closing_by_limits(hand), _fingertip_effects(hand)
    postures = (hand.expand(closing_posture(hand, share)) for share in (0.0, 0.5))
    opened, half = (quat_rotate(body_poses(hand, IDENTITY_POSE, q)[0, :, 3:], hand.axis) for q in postures)
    flexed, crossed, flexed_way, crossed_way = np.zeros((4, hand.dofs))
    seen = np.zeros(hand.dofs, bool)
    for number, chain in enumerate(finger_chains(hand)):
        dofs = hand.dof[chain]
        seen[dofs] = True
        moving = ways[dofs, number] > _MOVING * ways[dofs, number].max(initial=1e-9)
        if not moving.any():
            continue
        along = half[chain] @ half[chain[int(np.argmax(moving))]]
        flexes = np.abs(along) > _PARALLEL
        sense = np.sign(along * hand.multiplier[chain])
        rate, way = (sense * flexing[dofs, number])[flexes].sum(), ways[dofs, number][flexes].sum()
        np.add.at(flexed, dofs[flexes], sense[flexes] * rate)
        np.add.at(flexed_way, dofs[flexes], way)
        crosses = ~flexes & moving & (np.abs(opened[chain] @ hand.palm.approach) < _ABOUT)
        np.add.at(crossed, dofs[crosses], opposing[dofs[crosses], number])
        np.add.at(crossed_way, dofs[crosses], ways[dofs[crosses], number])
    bends = np.where(np.abs(flexed) > _TIE * flexed_way, np.sign(flexed), limits)
    opposes = np.where((np.abs(crossed) > _TIE * crossed_way) & (limits != 0), np.sign(crossed), 0.0)
    bends[np.abs(hand.lower + hand.upper) < 2 * _EVEN * hand.span] = 0.0
    # Limits alone decide for a joint that leads to no fingertip.
    return np.where(seen, np.where(flexed_way > 0, bends, opposes), limits)


def _fingertip_effects(hand: HandModel) -> tuple[Floats, Floats, Floats]:
    """Measure the effect of each dof on each fingertip over the dof's range from lower to upper limit.
    Return three arrays (D, T) [m], summed over postures of the other dofs: decrease of the distances to the other tips
    and to the palm; decrease of the distance to the other tips, plus motion along the approach; the path's length."""
    flexing, opposing, ways = np.zeros((3, hand.dofs, len(hand.fingertips)))
    for share in _SHARES:
        for dof in range(hand.dofs):
            q = np.tile(closing_posture(hand, share), (3, 1))
            q[:, dof] = hand.lower[dof] + np.array([0.0, 0.5, 1.0]) * hand.span[dof]
            low, _, high = seen = tip_positions(hand, q)
            nearer = _tip_distances(low) - _tip_distances(high)
            to_palm = (np.linalg.norm(one - hand.palm.centre, axis=1) for one in (low, high))
            flexing[dof] += nearer + next(to_palm) - next(to_palm)
            opposing[dof] += nearer + (high - low) @ hand.palm.approach
            ways[dof] += np.linalg.norm(np.diff(seen, axis=0), axis=2).sum(axis=0)
    return flexing, opposing, ways


def _tip_distances(tip: Floats) -> Floats:
    """Return the distance (T,) of each tip from the mean of the other tips; tips (T, 3) [m]."""
    others = (tip.sum(axis=0) - tip) / max(len(tip) - 1, 1)
    return np.asarray(np.linalg.norm(tip - others, axis=1)) if len(tip) > 1 else np.zeros(1)


def finger_chains(hand: HandModel) -> list[list[int]]:
    """Return the bodies whose joints move each fingertip, the last one first, up to the palm."""
    own = set(range(1, hand.bodies)) - set(shared_bodies(hand))
    return [[body for body in hand.chain(tip) if body in own] for tip in hand.fingertips]


def shared_bodies(hand: HandModel) -> list[int]:
    """Return the bodies that carry all fingertips: root, forearm and wrist, palm."""
    if len(hand.fingertips) < 2:
        return [0]
    chains = [[0, *hand.chain(tip)[::-1]] for tip in hand.fingertips]
    return [same[0] for same in zip(*chains, strict=False) if len(set(same)) == 1]


def closing_posture(hand: HandModel, share: float | Floats) -> Floats:
    """Return postures (..., D) at shares (..., 1) from open (0) to closed (1); other dofs stay near 0."""
    start = np.where(hand.closing < 0, hand.upper, hand.lower)
    end = np.where(hand.closing < 0, hand.lower, hand.upper)
    rest = np.clip(0.0, hand.lower, hand.upper)
    return np.where(hand.closing == 0, rest, start + share * (end - start))


def tip_positions(hand: HandModel, q: Floats) -> Floats:
    """Return the centres (..., T, 3) of the fingertip bodies in the root frame [m] for postures (..., D)."""
    many = q.reshape(-1, hand.dofs)
    poses = body_poses(hand, np.tile(IDENTITY_POSE, (len(many), 1)), hand.expand(many))
    centre = {p.body: p.vertices.mean(axis=0) for p in hand.pieces}
    at = [apply(poses[:, b], centre.get(b, np.zeros(3))) for b in hand.fingertips]
    return np.stack(at, axis=1).reshape(*q.shape[:-1], -1, 3)
