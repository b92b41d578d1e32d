"""Where a hand presses: the pads of its jaws, or those of its fingertips."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from service.model.transforms import IDENTITY_POSE, Floats, quat_conjugate, quat_rotate, spread_directions
from worker.hands.jaws import jaws_of
from worker.hands.kinematics import body_poses
from worker.hands.model import HandModel
from worker.hands.surface import sample_surface

#: Share of a fingertip's speed, and so of its length, within which its points are its pad.
PAD: Final = 0.5
#: Least cosine of a pad's normals with its motion.
_AHEAD: Final = 0.7
#: Directions in which a fingertip is measured.
_DIRECTIONS: Final = 256
#: Points of the hand's surface that pads are made of.
_POINTS: Final = 1000


@dataclass(frozen=True)
class Pad:
    """A part of a body's surface that presses; in the body's frame."""

    body: int
    centre: Floats
    """(3,) [m]"""
    normal: Floats
    """(3,) unit: where it presses."""
    points: Floats
    """(P, 3) of the surface [m]; none where the body has no shape."""


def pads_of(hand: HandModel) -> tuple[Pad, ...]:
    """The surfaces of a gripper that meet; of another hand the inner sides of its fingertips."""
    jaws = jaws_of(hand)
    if jaws is None:
        return tuple(fingertip_pad(hand, tip) for tip in hand.fingertips)
    found = []
    for side in (jaws.first, ~jaws.first):
        for body in np.unique(jaws.points.body[side]).tolist():
            mine = side & (jaws.points.body == body)
            place, look = jaws.points.position[mine], jaws.points.normal[mine].mean(axis=0)
            found.append(Pad(body, place.mean(axis=0), look / max(float(np.linalg.norm(look)), 1e-9), place))
    return tuple(found)


def fingertip_pad(hand: HandModel, tip: int) -> Pad:
    """Where and whereto a fingertip presses: the end of the side that its last joint moves ahead."""
    points = sample_surface(hand, _POINTS)
    mine = points.body == tip
    place, normal = points.position[mine], points.normal[mine]
    chain, body = [], tip
    while body > 0:
        chain.append(body)
        body = int(hand.parent[body])
    driven = [b for b in chain if hand.closing[hand.dof[b]] != 0] or chain
    if not len(place) or not driven:
        return Pad(tip, np.zeros(3), np.array([0.0, 0, 1]), np.zeros((0, 3)))
    # A joint that turns the tip about itself moves no side of it ahead: then one nearer to the palm tells.
    chosen = next((part for body in driven if (part := _moved_ahead(hand, tip, body, place, normal)).any()), None)
    if chosen is None:
        # Nothing tells; normals of a whole tip would cancel to rounding noise. The palm looks at what is held.
        ahead = quat_rotate(quat_conjugate(_pose(hand, tip)[3:]), hand.palm.approach)
        chosen = normal @ ahead > _AHEAD
        if not chosen.any():
            return Pad(tip, place.mean(axis=0), ahead, place)
    look = normal[chosen].mean(axis=0)
    return Pad(tip, place[chosen].mean(axis=0), look / max(float(np.linalg.norm(look)), 1e-9), place[chosen])


def thinnest_fingertip(hand: HandModel) -> float:
    """Least width of a fingertip in any direction [m]; 0 where one has no shape."""
    ways, tips = spread_directions(_DIRECTIONS), []
    for tip in hand.fingertips:
        corners = [piece.vertices for piece in hand.pieces if piece.body == tip]
        tips.append(float(np.ptp(np.concatenate(corners) @ ways.T, axis=0).min()) if corners else 0.0)
    return min(tips, default=0.0)


def _moved_ahead(hand: HandModel, tip: int, driven: int, place: Floats, normal: Floats) -> NDArray[np.bool_]:
    """(P,) points of a tip that the joint of a body moves along their normals, and of those the fastest."""
    dof = int(hand.dof[driven])
    step = np.zeros(hand.dofs)
    step[dof] = 1e-4 * (hand.closing[dof] or 1.0)
    q = np.stack([hand.preshape, hand.preshape + step])
    pose = body_poses(hand, np.tile(IDENTITY_POSE, (2, 1)), hand.expand(q))[:, tip]
    moved = quat_rotate(pose[:, None, 3:], place[None]) + pose[:, None, :3]
    move = quat_rotate(quat_conjugate(pose[0, 3:]), moved[1] - moved[0])
    speed = np.linalg.norm(move, axis=1)
    ahead = np.einsum("ij,ij->i", move / np.maximum(speed, 1e-12)[:, None], normal) > _AHEAD
    far = speed >= speed.max() - PAD * np.ptp(speed)
    return np.asarray(ahead & far if (ahead & far).any() else ahead)


def _pose(hand: HandModel, body: int) -> Floats:
    return np.asarray(body_poses(hand, IDENTITY_POSE, hand.expand(hand.preshape))[0, body])
