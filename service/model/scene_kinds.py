"""What stands in a scene of each kind: its supports as half-spaces and boxes, in the scene frame."""

from __future__ import annotations

import math
from typing import Final

from service.model.scene_spec import Box, HalfSpace, SceneSpec

#: Inner size of a bin, height of its walls and their thickness [m].
BIN_SIZE: Final = (0.40, 0.30)
BIN_HEIGHT: Final = 0.15
WALL: Final = 0.02
#: Width and depth of a shelf's boards, and the height between them [m]; it is open towards -x.
SHELF_SIZE: Final = (0.80, 0.35)
SHELF_HEIGHT: Final = 0.35
#: A half-space whose normal is so upright (cosine) is a table.
UPRIGHT: Final = 1 - 1e-6


def supports_in(spec: SceneSpec) -> tuple[HalfSpace | Box, ...]:
    """Supports of a scene in the scene frame; none for a free object."""
    if spec.kind == "free":
        return ()
    if spec.kind == "file":
        return spec.supports
    if spec.kind == "table":
        return (HalfSpace(),)
    return _bin() if spec.kind == "bin" else _shelf()


def has_table(spec: SceneSpec) -> bool:
    """Whether a scene has a level half-space."""
    flat = (one for one in supports_in(spec) if isinstance(one, HalfSpace))
    return any(one.normal[2] / math.hypot(*one.normal) > UPRIGHT for one in flat)


def _box(x: float, y: float, z: float, size: tuple[float, float, float]) -> Box:
    return Box(size=size, pose=(x, y, z, 1.0, 0.0, 0.0, 0.0))


def _bin() -> tuple[HalfSpace | Box, ...]:
    (x, y), z = BIN_SIZE, BIN_HEIGHT / 2
    along, across = (WALL, y + 2 * WALL, BIN_HEIGHT), (x, WALL, BIN_HEIGHT)
    ends = [_box(s * (x + WALL) / 2, 0, z, along) for s in (-1, 1)]
    sides = [_box(0, s * (y + WALL) / 2, z, across) for s in (-1, 1)]
    return (HalfSpace(), *ends, *sides)


def _shelf() -> tuple[HalfSpace | Box, ...]:
    width, depth = SHELF_SIZE
    board = (depth, width, WALL)
    return (
        _box(0, 0, -WALL / 2, board),
        _box((depth + WALL) / 2, 0, SHELF_HEIGHT / 2, (WALL, width, SHELF_HEIGHT + 2 * WALL)),
        _box(0, 0, SHELF_HEIGHT + WALL / 2, board),
    )
