"""The geometric gate: grasps that no verdict can save, because the hand is inside the object or inside itself."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

#: Deepest hand-object penetration [mm]: about what a finger pad gives under load, and a fifth of what the protocols of
#: the field refuse (10 mm).
MAX_PENETRATION_MM: Final = 2.0
#: Deepest hand-hand penetration [mm]: collision shapes of neighbouring links overlap by this much in real hand models.
MAX_SELF_PENETRATION_MM: Final = 3.0
#: Links in contact: one link cannot hold anything against gravity from every side.
MIN_CONTACT_LINKS: Final = 2


#: The gates by name, in their order.
GATES: Final = ("penetration", "self_penetration", "contacts")


def failed_gate(quality: Mapping[str, NDArray[Any]]) -> list[str]:
    """Of each of N grasps the first gate that it does not pass; of one that passes all, the last."""
    deep = ~(quality["quality/penetration_depth_mm"] <= MAX_PENETRATION_MM)
    itself = ~(quality["quality/self_penetration_depth_mm"] <= MAX_SELF_PENETRATION_MM)
    return [GATES[0 if one else 1 if two else 2] for one, two in zip(deep, itself, strict=True)]


def passes(quality: Mapping[str, NDArray[Any]]) -> NDArray[np.uint8]:
    """1 for each of the N grasps that passes, else 0; a grasp with a nan does not."""
    ok = (
        (quality["quality/penetration_depth_mm"] <= MAX_PENETRATION_MM)
        & (quality["quality/self_penetration_depth_mm"] <= MAX_SELF_PENETRATION_MM)
        & (quality["quality/contact_links"] >= MIN_CONTACT_LINKS)
    )
    return ok.astype(np.uint8)
