"""Regions of an object as half-spaces, and cones of approach directions, as text."""

from __future__ import annotations

import math
import re
from typing import Final

Plane = tuple[float, float, float, float]

MOST_PLANES: Final = 12
#: Largest number in a region or a cone; larger ones overflow in single precision.
LARGEST: Final = 1e6
_NUMBER: Final = r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?"
_BOUND: Final = re.compile(rf"([xyz])\s*([<>])\s*({_NUMBER})")


def parse_region(text: str) -> list[Plane]:
    """Parse bounds such as `z > 0.05, x < 0.02` [m]; the region fulfils all of them.
    Return its half-spaces n.x <= d as (n, d). Raises ValueError: another form, or more than `MOST_PLANES` bounds."""
    parts = text.split(",")
    found = [match for part in parts if (match := _BOUND.fullmatch(part.strip())) and abs(float(match[3])) <= LARGEST]
    if len(found) < len(parts) or len(parts) > MOST_PLANES:
        raise ValueError(f"a region is up to {MOST_PLANES} bounds in metres, such as z > 0.05, x < 0.02; got {text!r}")
    planes = []
    for match in found:
        axis, sign = "xyz".index(match[1]), 1.0 if match[2] == "<" else -1.0
        x, y, z = (sign if k == axis else 0.0 for k in range(3))
        planes.append((x, y, z, sign * float(match[3])))
    return planes


def parse_cone(text: str) -> tuple[tuple[float, float, float], float]:
    """Parse `x, y, z, degrees` to an axis and the largest angle from it.
    Raises ValueError: another form, no direction, or an angle outside 1 to 180 degrees."""
    parts = [part.strip() for part in text.split(",")]
    if len(parts) == 4 and all(re.fullmatch(_NUMBER, part) for part in parts):
        x, y, z, degrees = map(float, parts)
        if 1e-6 < math.hypot(x, y, z) <= LARGEST and 1.0 <= degrees <= 180.0:
            return (x, y, z), degrees
    raise ValueError(
        f"a cone is an axis and an angle of 1 to 180 degrees, such as 0, 0, -1, 30 (from above); got {text!r}"
    )
