"""Words of robustness: the axes along which a model of a hand and an object may be another than ours."""

from __future__ import annotations

from enum import IntEnum
from typing import Final

#: Models around the nominal one in which a grasp is judged, where nobody says how many.
MODELS: Final = 8
MOST_MODELS: Final = 64


class Axis(IntEnum):
    """What differs from the nominal model. Numbers stand in shards: new axes come last."""

    NONE = 0
    SHAPES = 1
    JOINTS = 2
    COUPLINGS = 3
    FRICTION = 4
    MASS = 5
    CENTRE = 6
    POSE = 7
    CALIBRATION = 8
    ORDER = 9

    @property
    def word(self) -> str:
        """As documents and pages say it."""
        return self.name.lower()


#: What differs on each axis, for people.
MEANINGS: Final[dict[Axis, str]] = {
    Axis.SHAPES: "collision shapes",
    Axis.JOINTS: "joint drives",
    Axis.COUPLINGS: "couplings of joints",
    Axis.FRICTION: "friction",
    Axis.MASS: "mass of the object",
    Axis.CENTRE: "centre of mass",
    Axis.POSE: "pose of the object",
    Axis.CALIBRATION: "calibration of the hand",
    Axis.ORDER: "order of closing",
}


#: Words of the axes.
WORDS: Final = tuple(axis.word for axis in MEANINGS)


def axis_word(number: int) -> str | None:
    """The word of an axis as a shard has it; None: none, or one that this version does not know."""
    return Axis(number).word if number in MEANINGS else None
