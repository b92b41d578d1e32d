"""Regions of an object, cones of approach directions and wrist poses, as text."""

import math
import re
from dataclasses import dataclass
from typing import Final

Plane = tuple[float, float, float, float]

MOST_PLANES: Final = 12
#: Largest number in a region or a cone; larger ones overflow in single precision.
LARGEST: Final = 1e6
_NUMBER: Final = r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?"
_BOUND: Final = re.compile(rf"([xyz])\s*([<>])\s*({_NUMBER})")


_PART: Final = re.compile(r"part +(.*)", re.DOTALL)
_COLOUR: Final = re.compile(r"color +#([0-9a-fA-F]{6})")
#: Largest length of a part's name.
LONGEST_NAME: Final = 80


@dataclass(frozen=True)
class RegionSpec:
    """A region of an object: bounds, or a part of its mesh, or the faces of a colour."""

    planes: tuple[Plane, ...] = ()
    """Half-spaces n.x <= d as (n, d), all of which contain the region."""
    part: str = ""
    colour: str = ""
    """sRGB as #rrggbb, lower case."""

    def __str__(self) -> str:
        return f"color {self.colour}" if self.colour else f"part {self.part}"


def is_part_name(text: str) -> bool:
    """Check whether a region can name a part of a mesh by this text."""
    return 0 < len(text) <= LONGEST_NAME and text.isprintable() and text == text.strip()


def parse_region(text: str) -> RegionSpec:
    """Parse bounds such as `z > 0.05, x < 0.02` [m], `part NAME` or `color #rrggbb`; all bounds apply.
    Raises ValueError: another form, more than `MOST_PLANES` bounds, or a name that is too long or not printable."""
    if (colour := _COLOUR.fullmatch(text.strip())) is not None:
        return RegionSpec(colour=f"#{colour[1].lower()}")
    if (part := _PART.fullmatch(text.strip())) is not None and is_part_name(part[1]):
        return RegionSpec(part=part[1])
    bounds = text.split(",")
    found = [one for part in bounds if (one := _BOUND.fullmatch(part.strip())) and abs(float(one[3])) <= LARGEST]
    if len(found) < len(bounds) or len(bounds) > MOST_PLANES:
        raise ValueError(
            f"a region is up to {MOST_PLANES} bounds in metres, such as z > 0.05, x < 0.02; or part NAME; or "
            f"color #rrggbb; got {text!r}"
        )
    planes = list[Plane]()
    for match in found:
        axis, sign = "xyz".index(match[1]), 1.0 if match[2] == "<" else -1.0
        x, y, z = (sign if k == axis else 0.0 for k in range(3))
        planes.append((x, y, z, sign * float(match[3])))
    return RegionSpec(tuple(planes))


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
    """Parse `x, y, z, degrees` to an axis and the largest angle from it.
    Raises ValueError: another form, no direction, or an angle outside 1 to 180 degrees."""
    parts = [part.strip() for part in text.split(",")]
    if len(parts) == 4 and all(re.fullmatch(_NUMBER, part) for part in parts):
        x, y, z, degrees = map(float, parts)
        if 1e-6 < math.hypot(x, y, z) <= LARGEST and 1.0 <= degrees <= 180.0:
            return (x, y, z), degrees
    raise ValueError(f"a cone is an axis and an angle of 1 to 180 degrees, such as 0, 0, -1, 30; got {text!r}")
