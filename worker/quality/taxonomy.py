"""Which type a grasp is of: power, precision or lateral, by what of the hand touches.

Types are those of Napier (1956) and of the GRASP taxonomy (Feix et al., IEEE THMS 2016), told by the opposition that
Iberall (1987) found in them:

    power      palm opposition: the palm touches, or two digits at least wrap: they touch with more than their last
               links, and not by a side
    lateral    side opposition: half at least of the digits that touch do so by a side
    precision  pad opposition: all others in which two digits touch

They are asked in this order. A *digit* is a chain of bodies that ends in a fingertip; all other bodies
are palm. A digit touches *by a side* where more than half of its surface within 2 mm of the object looks along the axis
of its flexion, to within 45 degrees. Robots have other hands than people: a jaw has no side, so a gripper's grasps are
of precision, or of power where its palm touches.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from service.model.integers import distinct_values
from service.model.metrics import GraspType
from service.model.transforms import Floats
from worker.hands.model import HandModel, JointType
from worker.quality.contact import LINK_CONTACT_M, finger_of_body
from worker.quality.probe import Distances, Probe

#: Cosine between a digit's surface and its axis of flexion above which the surface is a side: 45 degrees.
SIDE_COS: Final = float(np.sqrt(0.5))
#: Digits that must touch with more than their last links where the palm is free.
ENVELOPING: Final = 2


def grasp_types(probe: Probe, found: Distances) -> NDArray[np.int32]:
    """(B,) `GraspType` of B grasps."""
    hand = probe.hand
    finger = finger_of_body(hand)
    touching = probe.body_distance(found) < LINK_CONTACT_M
    digits = np.array(distinct_values(finger[finger >= 0]), finger.dtype)
    inner = np.array([body for body in np.flatnonzero(finger >= 0) if body not in hand.fingertips], np.intp)
    palm = touching[:, finger < 0].any(axis=1)
    touches = np.stack([touching[:, finger == digit].any(axis=1) for digit in digits], axis=1)
    wraps = np.stack([touching[:, inner[finger[inner] == digit]].any(axis=1) for digit in digits], axis=1)
    sides = touches & _by_sides(probe, found, finger, digits)
    count = touches.sum(axis=1)
    lateral = sides.any(axis=1) & (2 * sides.sum(axis=1) >= count)
    power = palm | ((wraps & ~sides).sum(axis=1) >= ENVELOPING)
    told = np.where(lateral, GraspType.LATERAL, GraspType.PRECISION)
    told = np.where(power, GraspType.POWER, told)
    return np.where(count + palm < 2, GraspType.NONE, told).astype(np.int32)


def _by_sides(
    probe: Probe, found: Distances, finger: NDArray[np.int32], digits: NDArray[np.int32]
) -> NDArray[np.bool_]:
    """(B, digits) whether more than half of what is near of a digit are its sides."""
    points = probe.points
    near = np.where(np.abs(found.distance) < LINK_CONTACT_M, points.area, 0.0)
    side = np.abs(np.einsum("ni,ni->n", points.normal, _flexion(probe.hand)[points.body])) > SIDE_COS
    mine = finger[points.body][:, None] == digits
    return np.asarray(near @ (mine & side[:, None]) > 0.5 * (near @ mine))


def _flexion(hand: HandModel) -> Floats:
    """(L, 3) axis in the body's own frame about which a body closes; 0 where its joint does not close or turn."""
    # A body turns about its joint's axis, which therefore stands still in it.
    bends = (hand.joint_type == JointType.REVOLUTE) & (hand.dof >= 0)
    bends &= np.where(hand.dof >= 0, hand.closing[hand.dof], 0.0) != 0
    return np.where(bends[:, None], hand.axis, 0.0)
