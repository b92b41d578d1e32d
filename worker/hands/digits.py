"""Digits of a hand: their names, the parts of their surface, and hands that use some of them only."""

from collections.abc import Sequence
from dataclasses import replace
from enum import IntEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.errors import InputError
from graspd.service.model.transforms import IDENTITY_POSE, Floats
from graspd.worker.hands.jaws import jaws_of
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.model import HandModel, JointType, SurfacePoints
from graspd.worker.hands.pinch_postures import opposing_finger
from graspd.worker.objects.memory_cache import cached_by_content

#: Names of digits: the opposing one, then the others by increasing distance of their bases from its base.
NAMES: Final = ("thumb", "index", "middle", "ring", "little", "sixth")
#: Cosine between a surface normal and the axis of flexion above which the surface is a side: 45 degrees.
SIDE_COS: Final = float(np.sqrt(0.5))
#: Half the remaining range of locked joints, as a share of their range.
_LOCKED: Final = 1e-3


class Part(IntEnum):
    """Part of a body's surface."""

    NONE = 0
    WHOLE = 1
    PAD = 2
    """All but the sides."""
    SIDES = 3


@cached_by_content(32)
def digit_names(hand: HandModel) -> tuple[str, ...]:
    """Return the name of each fingertip's digit; empty for a gripper and for hands without opposed digits."""
    count = len(hand.fingertips)
    if not 2 <= count <= len(NAMES) or jaws_of(hand) is not None:
        return ()
    thumb = opposing_finger(hand)
    base = np.array([_base(hand, tip) for tip in hand.fingertips])
    order = np.argsort(np.linalg.norm(base - base[thumb], axis=1), kind="stable")
    names = [""] * count
    for name, digit in zip(NAMES, [thumb, *(d for d in order.tolist() if d != thumb)], strict=False):
        names[digit] = name
    return tuple(names)


def digit_order(hand: HandModel) -> NDArray[np.intp]:
    """Return the fingertips' indices (F,) in the order of `NAMES`; in the hand's own order without names."""
    names = digit_names(hand)
    return np.argsort([NAMES.index(name) for name in names]) if names else np.arange(len(hand.fingertips))


def _base(hand: HandModel, tip: int) -> Floats:
    """Return the place (3,) at which a digit leaves the palm, in the root frame at rest [m]."""
    first = hand.chain(tip)[0]
    return np.asarray(body_poses(hand, IDENTITY_POSE, hand.expand(hand.preshape))[0, first, :3])


def finger_of_body(hand: HandModel) -> NDArray[np.int32]:
    """Return each body's finger (L,), an index into `HandModel.fingertips`; -1 for palm and shared bodies."""
    finger = np.full(hand.bodies, -1, np.int32)
    members = np.zeros(hand.bodies, np.int32)
    for number, body in enumerate(hand.fingertips):
        while body > 0:
            finger[body] = number
            members[body] += 1
            body = int(hand.parent[body])
    finger[members > 1] = -1
    return finger


def is_side(hand: HandModel, points: SurfacePoints) -> NDArray[np.bool_]:
    """Return a mask (N,) of points whose normal is along the axis about which their body closes.
    Bodies of joints that do not close have no sides."""
    bends = (hand.joint_type == JointType.REVOLUTE) & (hand.dof >= 0)
    bends &= np.where(hand.dof >= 0, hand.closing[hand.dof], 0.0) != 0
    # The axis of a body's joint is constant in the body's frame.
    axes = np.where(bends[:, None], hand.axis, 0.0)
    return np.asarray(np.abs(np.einsum("ni,ni->n", points.normal, axes[points.body])) > SIDE_COS)


def points_of_parts(hand: HandModel, parts: NDArray[np.int32], points: SurfacePoints) -> NDArray[np.bool_]:
    """Return a mask (N,) of points on the `Part` (L,) of their body."""
    part, side = parts[points.body], is_side(hand, points)
    return (part == Part.WHOLE) | ((part == Part.PAD) & ~side) | ((part == Part.SIDES) & side)


def hand_with_digits(hand: HandModel, names: Sequence[str]) -> HandModel:
    """Return the hand with fingertips of the named digits only.
    Joints of the other digits are locked open.
    Raises InputError: an unknown digit, or fewer than two."""
    known = digit_names(hand)
    if not known:
        raise InputError(f"{hand.name} has no digits to choose: a gripper closes all its fingers")
    if unknown := [name for name in names if name not in known]:
        raise InputError(f"{hand.name} has no {unknown[0]}; its digits are {', '.join(sorted(known, key=NAMES.index))}")
    if len(set(names)) < 2:
        raise InputError("a grasp needs two digits or more: name another one")
    used = [digit for digit, name in enumerate(known) if name in names]
    finger = finger_of_body(hand)
    idle = np.zeros(hand.dofs, bool)
    for body in np.flatnonzero((finger >= 0) & ~np.isin(finger, used)):
        idle[hand.dof[body]] = True
    for body in np.flatnonzero(np.isin(finger, [-1, *used]) & (hand.dof >= 0)):
        idle[hand.dof[body]] = False
    opened = np.where(hand.closing > 0, hand.lower, np.where(hand.closing < 0, hand.upper, hand.preshape))
    middle = np.clip(opened, hand.lower + _LOCKED * hand.span, hand.upper - _LOCKED * hand.span)
    return replace(
        hand,
        fingertips=tuple(hand.fingertips[digit] for digit in used),
        lower=np.where(idle, middle - _LOCKED * hand.span, hand.lower),
        upper=np.where(idle, middle + _LOCKED * hand.span, hand.upper),
        preshape=np.where(idle, middle, hand.preshape),
        closing=np.where(idle, 0.0, hand.closing),
    )
