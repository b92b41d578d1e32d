"""Grasp types by contact: power, precision and lateral grasps, and types of the GRASP taxonomy.

The first three are those of Napier (1956) and of the GRASP taxonomy (Feix et al., IEEE THMS 2016), by opposition
(Iberall 1987):

- power, palm opposition: the palm touches, or at least two digits wrap. A wrapping digit touches with more than its
last link, and not by a side;
- lateral, side opposition: at least half of the touching digits touch by a side;
- precision, pad opposition: two digits touch, and neither other type applies.

They are tested in this order. A *digit* is a chain of bodies that ends in a fingertip; all other bodies are palm. A
digit touches *by a side* if most of its surface within 2 mm of the object faces along its axis of flexion. The
tolerance is 45 degrees. A jaw has no side, so a gripper's grasps are of type precision, or power where its palm
touches.

The taxonomy describes its types in words, by opposition, virtual fingers and position of the thumb. `RULES` states them
by contacts: opposition, touching digits, arrangement of the fingers, and width. Fingers are *in line* if the object's
normals at their contacts are nearly parallel. The fingers of a distal grasp touch below the pads without the palm
(MacKenzie and Iberall, The Grasping Hand, 1994, app. B). Those of a fixed hook hold the object against the palm without
the thumb; all four wrap, unlike those of the flat palmar grasp (30)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.grasp_types import TAXONOMY
from graspd.service.model.metrics import GraspType
from graspd.service.model.transforms import Floats
from graspd.worker.hands.digits import digit_order, finger_of_body, is_side
from graspd.worker.hands.model import HandModel
from graspd.worker.quality.contact import LINK_CONTACT_M
from graspd.worker.quality.probe import NearestPoints, Probe

Mask = NDArray[np.bool_]

#: Least number of wrapping digits of a power grasp if the palm does not touch.
ENVELOPING: Final = 2
#: Least cosine between the normals of two fingers in line: 30 degrees.
IN_LINE_COS: Final = float(np.cos(np.deg2rad(30.0)))
#: Largest sine between the digits' normals and their common plane, in a grasp of a disk: 20 degrees.
FLAT_SINE: Final = float(np.sin(np.deg2rad(20.0)))
#: Widths that separate the grasps of small, medium and large diameters [m].
MEDIUM_M: Final = (0.03, 0.06)


@dataclass(frozen=True)
class ContactPattern:
    """Contacts of B grasps by digit.

    The F digits are in the order of `digit_order`: the thumb, if any, is first."""

    palm: Mask
    """(B,) whether the palm touches."""
    touches: Mask
    """(B, F) whether the digit touches; further fields are undefined for digits that do not."""
    wraps: Mask
    """(B, F) whether a body of the digit other than its fingertip touches."""
    by_side: Mask
    """(B, F) whether most of the digit's contact is on a side."""
    place: Floats
    """(B, F, 3) mean position of the contact [m]."""
    normal: Floats
    """(B, F, 3) mean outward unit normal of the object at the contact."""

    @classmethod
    def of(cls, probe: Probe, found: NearestPoints, body_distance: Floats) -> ContactPattern:
        """Find the contacts from the distances of points and the distances (B, L) of bodies [m]."""
        hand, points = probe.hand, probe.points
        finger, order = finger_of_body(hand), digit_order(hand)
        touching = body_distance < LINK_CONTACT_M
        digits = [np.flatnonzero(finger == digit) for digit in order]
        inner = [bodies[~np.isin(bodies, hand.fingertips)] for bodies in digits]
        near = np.where(np.abs(found.distance) < LINK_CONTACT_M, points.area, 0.0)
        of_digit = (finger[points.body][:, None] == order).astype(float)
        total = near @ of_digit
        share = np.maximum(total, 1e-12)[..., None]
        normal = np.einsum("bn,nf,bni->bfi", near, of_digit, found.normal)
        length = np.linalg.norm(normal, axis=-1, keepdims=True)
        return cls(
            palm=np.asarray(touching[:, finger < 0].any(axis=1)),
            touches=np.stack([touching[:, bodies].any(axis=1) for bodies in digits], axis=1),
            wraps=np.stack([touching[:, bodies].any(axis=1) for bodies in inner], axis=1),
            by_side=np.asarray(near @ (of_digit * is_side(hand, points)[:, None]) > 0.5 * total),
            place=np.einsum("bn,nf,bni->bfi", near, of_digit, found.closest) / share,
            normal=normal / np.maximum(length, 1e-12),
        )

    @cached_property
    def types(self) -> NDArray[np.int32]:
        """(B,) `GraspType`."""
        sides, count = self.touches & self.by_side, self.touches.sum(axis=1)
        lateral = sides.any(axis=1) & (2 * sides.sum(axis=1) >= count)
        power = self.palm | ((self.wraps & ~sides).sum(axis=1) >= ENVELOPING)
        told = np.where(lateral, GraspType.LATERAL, GraspType.PRECISION)
        told = np.where(power, GraspType.POWER, told)
        return np.where(count + self.palm < 2, GraspType.NONE, told).astype(np.int32)

    @property
    def digits(self) -> NDArray[np.int32]:
        """(B,) sum of 2^k over the touching digits k; digit 0 is the thumb."""
        return np.asarray(self.touches @ (1 << np.arange(self.touches.shape[1])), np.int32)

    @cached_property
    def in_line(self) -> Mask:
        """(B,) whether the normals of all touching fingers, without the thumb, are nearly parallel."""
        cosine = np.einsum("bfi,bgi->bfg", self.normal[:, 1:], self.normal[:, 1:])
        both = self.touches[:, 1:, None] & self.touches[:, None, 1:]
        return np.asarray((np.where(both, cosine, 1.0) >= IN_LINE_COS).all(axis=(1, 2)))

    @cached_property
    def flat(self) -> Mask:
        """(B,) whether the normals of all touching digits are nearly in one plane."""
        values = np.linalg.svd(np.where(self.touches[..., None], self.normal, 0.0), compute_uv=False)
        return np.asarray(values[:, -1] <= FLAT_SINE * np.sqrt(np.maximum(self.touches.sum(axis=1), 1)))

    @cached_property
    def width(self) -> Floats:
        """(B,) distance of the thumb's contact from the mean of the other digits' contacts [m]."""
        others = self.touches[:, 1:, None]
        mean = (self.place[:, 1:] * others).sum(axis=1) / np.maximum(others.sum(axis=1), 1)
        return np.asarray(np.linalg.norm(mean - self.place[:, 0], axis=-1))

    def taxonomy(self) -> NDArray[np.int32]:
        """Return the number (B,) of the first taxonomy type whose rule applies; 0 if none does."""
        out = np.zeros(len(self.palm), np.int32)
        for name, rule in RULES.items():
            if name in TAXONOMY:
                out = np.where((out == 0) & rule.applies(self), TAXONOMY[name], out)
        return out.astype(np.int32)


@dataclass(frozen=True)
class Rule:
    """Contacts of a grasp type."""

    kind: GraspType
    digits: int = 0
    """Number of touching digits; 0: any number."""
    thumb: bool = True
    """Whether the thumb touches, if the rule states digits or the palm."""
    palm: bool | None = None
    """Whether the palm touches; None: either."""
    arrangement: Literal["any", "line", "round", "disk", "sphere"] = "any"
    width: tuple[float, float] = (0.0, np.inf)
    """Range of `ContactPattern.width` [m]."""
    by_fingers: bool = False
    """Whether each finger must touch with more than its last link."""
    to_side: bool = False
    """Whether the thumb presses with its pad against a side of the other digit."""

    def applies(self, seen: ContactPattern) -> Mask:
        """Return a mask (B,) of the grasps of this type."""
        out = seen.types == self.kind
        if self.digits:
            out = out & (seen.touches.sum(axis=1) == self.digits)
        if self.palm is not None:
            out = out & (seen.palm == self.palm)
        if self.digits or self.palm:
            out = out & (seen.touches[:, 0] == self.thumb)
        if self.arrangement == "line":
            out = out & seen.in_line
        elif self.arrangement != "any":
            out = out & ~seen.in_line
            if self.arrangement != "round":
                out = out & (seen.flat == (self.arrangement == "disk"))
        if self.width != (0.0, np.inf):
            out = out & (seen.width >= self.width[0]) & (seen.width < self.width[1])
        if self.by_fingers:
            out = out & (seen.wraps | ~seen.touches)[:, 1:].all(axis=1)
        return out & ~seen.by_side[:, 0] if self.to_side else out


_PRECISION, _POWER, _LATERAL = GraspType.PRECISION, GraspType.POWER, GraspType.LATERAL
#: Rules of all types that a job may require. Names of the taxonomy are those of Feix et al.
RULES: Final = {
    "power": Rule(_POWER),
    "precision": Rule(_PRECISION),
    "pinch": Rule(_PRECISION, 2),
    "palmar_pinch": Rule(_PRECISION, 2),
    "prismatic_2_finger": Rule(_PRECISION, 3, arrangement="line"),
    "tripod": Rule(_PRECISION, 3, arrangement="round"),
    "prismatic_3_finger": Rule(_PRECISION, 4, arrangement="line"),
    "quadpod": Rule(_PRECISION, 4, arrangement="round"),
    "prismatic_4_finger": Rule(_PRECISION, 5, arrangement="line"),
    "precision_disk": Rule(_PRECISION, 5, arrangement="disk"),
    "precision_sphere": Rule(_PRECISION, 5, arrangement="sphere"),
    "ring": Rule(_POWER, 2, palm=False),
    "sphere_3_finger": Rule(_POWER, 3, palm=False),
    "sphere_4_finger": Rule(_POWER, 4, palm=False),
    "distal": Rule(_POWER, 5, palm=False, by_fingers=True),
    "small_diameter": Rule(_POWER, palm=True, arrangement="line", width=(0.0, MEDIUM_M[0])),
    "medium_wrap": Rule(_POWER, palm=True, arrangement="line", width=MEDIUM_M),
    "large_diameter": Rule(_POWER, 5, palm=True, arrangement="line", width=(MEDIUM_M[1], np.inf)),
    "power_disk": Rule(_POWER, palm=True, arrangement="disk"),
    "power_sphere": Rule(_POWER, palm=True, arrangement="sphere"),
    "fixed_hook": Rule(_POWER, 4, thumb=False, palm=True, by_fingers=True),
    "lateral": Rule(_LATERAL, 2, palm=False, to_side=True),
}


def pattern_of(hand: HandModel, probe: Probe, found: NearestPoints) -> ContactPattern:
    """Return the contacts from distances of hand points alone, without object points."""
    least = np.full((len(found.distance), hand.bodies), np.inf)
    for body in np.unique(probe.points.body):
        least[:, body] = found.distance[:, probe.points.body == body].min(axis=1)
    return ContactPattern.of(probe, found, least)
