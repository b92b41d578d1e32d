"""Two frames of an object: the file's, in which poses are told, and the centred one, in which the engine works.

Both have the same axes. The centred one lies in the middle of the mesh's bounding box, so results have the same bits
wherever the origin of the file lies.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from service.model.transforms import Floats, quat_rotate
from worker.grasps import moved

#: Digits of the longest extent to which coordinates are rounded, so that no sliver collapses; and the fewest of them in
#: which a mesh of decimals is looked for.
DIGITS: Final = 9
LEAST_DIGITS: Final = 5


@dataclass(frozen=True)
class Centred:
    """The points of a mesh about the middle of their bounding box, in the units of its file."""

    points: Floats
    """(V, 3)"""
    centre: Floats
    """(3,) the middle in the frame of the file."""
    resolution: float
    """Distance of two neighbouring numbers of the file where the mesh lies."""


def centred(points: Floats) -> Centred:
    """Points (V, 3) about their middle, rounded so that they do not depend on where the origin lies.

    Where all coordinates are decimals as far as the file's numbers tell, they become these decimals: a mesh of decimals
    is the same one at every distance that the numbers resolve.
    """
    low, extent = points.min(axis=0), float(np.ptp(points, axis=0).max())
    farthest = np.abs(points).max()
    # Files of 32-bit numbers are told by the numbers: theirs survive the conversion.
    with np.errstate(over="ignore"):
        single = bool((points == points.astype(np.float32)).all())
    resolution = float(np.spacing(np.float32(farthest) if single else farthest))
    size = np.floor(np.log10(extent)) if extent > 0 else 0.0
    finest = 10.0 ** (DIGITS - 1 - size)
    scale = 10.0 ** np.clip(np.floor(-np.log10(2 * resolution)), LEAST_DIGITS - 1 - size, DIGITS - 1 - size)
    steps = (points - low) * scale
    if (np.abs(steps - np.rint(steps)) > 1.01 * resolution * scale).any():
        steps, scale = (points - low) * finest, finest
    steps = np.rint(steps)
    ends = steps.min(axis=0) + steps.max(axis=0)
    # Twice the distance from the middle in whole steps: one division rounds, so it gives the same for every scale.
    return Centred((2 * steps - ends) / (2 * scale), low + ends / (2 * scale), resolution)


def carried(pose: ArrayLike, by: ArrayLike) -> Floats:
    """Poses (..., 7) of a frame of which the origin is moved by a vector (3,) of its own [m]."""
    pose, by = np.array(pose, float), np.asarray(by, float)
    if by.any():
        pose[..., :3] += quat_rotate(pose[..., 3:], by)
    return pose


def to_centre(pose: ArrayLike, centre: ArrayLike) -> Floats:
    """Poses (..., 7) of a centred frame from those of the file's frame, which has it at `centre` (3,); on the grid, so
    that there and back gives the same bits."""
    return moved(carried(pose, centre), np.zeros(3))


def to_file(pose: ArrayLike, centre: ArrayLike) -> Floats:
    """Poses (..., 7) of the file's frame from those of the centred one."""
    return carried(pose, -np.asarray(centre, float))
