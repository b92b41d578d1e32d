"""How different grasps are, in words and numbers that all rooms share: types, directions of approach, entropy."""

from __future__ import annotations

import math
from collections.abc import Iterable
from enum import IntEnum
from typing import Final


class GraspType(IntEnum):
    """What a hand does in a grasp, by the opposition in it; `worker.quality.taxonomy` has the rule."""

    NONE = 0
    """Not told: one digit alone touches, or nothing does."""
    POWER = 1
    PRECISION = 2
    LATERAL = 3


#: Directions fall into cells of equal area: bands of equal height z (Archimedes), each cut into equal azimuths.
BANDS: Final = 4
SECTORS: Final = 12
CELLS: Final = BANDS * SECTORS

#: Two grasps of a job are nearer than this only by accident [m]: mean distance between the same points of the hand's
#: surface. Twice as much is hard to tell apart in a picture; of 100 pairs of batches less than one has such a pair.
MIN_DISTANCE_M: Final = 0.005


def entropy_bits(counts: Iterable[int]) -> float:
    """Shannon entropy [bit] of how grasps are shared out to kinds; 0: all are of one, or there are none."""
    known = [count for count in counts if count > 0]
    total = sum(known)
    return -sum(count / total * math.log2(count / total) for count in known) + 0.0


def evenness(counts: Iterable[int], kinds: int) -> float:
    """Kinds that would be needed to spread as widely if each were used alike, over all kinds: 2^entropy / kinds.

    1 is even; 1 / kinds is all of one kind; 0 if there is none.
    """
    counts = list(counts)
    return float(2 ** entropy_bits(counts) / kinds) if any(counts) else 0.0
