"""Regions of an object as half-spaces, cones of approach directions, and wrist poses, as text."""

from __future__ import annotations

import math
import re
from typing import Final

Plane = tuple[float, float, float, float]

MOST_PLANES: Final = 12
_NUMBER: Final = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_BOUND: Final = re.compile(rf"([xyz])\s*([<>])\s*({_NUMBER})")


def parse_region(text: str) -> list[Plane]:
    """Parse bounds such as `z > 0.05, x < 0.02` [m]; the region fulfils all of them.
    Return its half-spaces n.x <= d as (n, d). Raises ValueError: another form, or more than `MOST_PLANES` bounds."""
    found = [_BOUND.fullmatch(part.strip()) for part in text.split(",")]
    if not 1 <= len(found) <= MOST_PLANES or None in found:
        raise ValueError(f"a region is up to {MOST_PLANES} bounds in metres, such as z > 0.05, x < 0.02; got {text!r}")
    planes = []
    for match in found:
        assert match is not None
        axis, sign = "xyz".index(match[1]), 1.0 if match[2] == "<" else -1.0
        x, y, z = (sign if k == axis else 0.0 for k in range(3))
        planes.append((x, y, z, sign * float(match[3])))
    return planes


def parse_pose(text: str) -> tuple[float, ...]:
    """Parse `x, y, z, qw, qx, qy, qz` [m].
    Raises ValueError: another form, or a quaternion whose norm differs from 1 by more than 1e-3."""
    parts = [part.strip() for part in text.split(",")]
    if len(parts) == 7 and all(re.fullmatch(_NUMBER, part) for part in parts):
        pose = tuple(map(float, parts))
        if abs(math.hypot(*pose[3:]) - 1.0) <= 1e-3:
            return pose
        raise ValueError(f"the quaternion qw, qx, qy, qz of a wrist pose has norm 1; got {math.hypot(*pose[3:]):.4g}")
    raise ValueError(f"a wrist pose is x, y, z, qw, qx, qy, qz in metres, such as 0, 0, 0.1, 1, 0, 0, 0; got {text!r}")


def parse_cone(text: str) -> tuple[tuple[float, float, float], float]:
    """Parse `x, y, z, degrees` to an axis and the largest angle from it; raise ValueError for anything else."""
    parts = [part.strip() for part in text.split(",")]
    if len(parts) == 4 and all(re.fullmatch(_NUMBER, part) for part in parts):
        x, y, z, degrees = map(float, parts)
        if math.hypot(x, y, z) > 1e-6 and 1.0 <= degrees <= 180.0:
            return (x, y, z), degrees
    raise ValueError(
        f"a cone is an axis and an angle of 1 to 180 degrees, such as 0, 0, -1, 30 (from above); got {text!r}"
    )
