"""Geometric gate against penetration of the object or the hand itself, regardless of the verdict."""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

#: Deepest hand-object penetration [mm]: about a finger pad's deformation, and a fifth of the usual limit of 10 mm.
MAX_PENETRATION_MM: Final = 2.0
#: Deepest hand-hand penetration [mm]: collision shapes of links in hand models overlap by about this much.
MAX_SELF_PENETRATION_MM: Final = 3.0
#: Fewest links in contact: a single link cannot hold an object against gravity in every direction.
MIN_CONTACT_LINKS: Final = 2
GATES: Final = ("penetration", "self_penetration", "contacts")  # in the order in which they are checked


def failed_gate(quality: Mapping[str, NDArray[Any]]) -> list[str]:
    """Return the first gate that each of N grasps fails; the last for a grasp that passes all."""
    deep = ~(quality["quality/penetration_depth_mm"] <= MAX_PENETRATION_MM)
    itself = ~(quality["quality/self_penetration_depth_mm"] <= MAX_SELF_PENETRATION_MM)
    return [GATES[0 if one else 1 if two else 2] for one, two in zip(deep, itself, strict=True)]


def passes_gate(quality: Mapping[str, NDArray[Any]]) -> NDArray[np.uint8]:
    """Return 1 for each of N grasps that passes, else 0; a grasp with a nan does not pass."""
    ok = (
        (quality["quality/penetration_depth_mm"] <= MAX_PENETRATION_MM)
        & (quality["quality/self_penetration_depth_mm"] <= MAX_SELF_PENETRATION_MM)
        & (quality["quality/contact_links"] >= MIN_CONTACT_LINKS)
    )
    return ok.astype(np.uint8)
