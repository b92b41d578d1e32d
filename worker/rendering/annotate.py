"""Labels of a picture: segmentation, boxes in the picture and in space, and further channels."""

from collections.abc import Iterable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.domain import EXTRA_CHANNELS
from graspd.service.model.errors import InputError, did_you_mean
from graspd.service.model.transforms import Floats

BACKGROUND, TABLE, OBJECT = 0, 1, 2


def tight_boxes(segmentation: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return boxes (V, 4) x_min y_min x_max y_max [px] of visible object pixels (V, H, W); nan if none.
    Edges are pixel edges: a single pixel (i, j) gives i, j, i + 1, j + 1."""
    mask = segmentation == OBJECT
    boxes = np.full((len(mask), 4), np.nan, np.float32)
    for view in np.flatnonzero(mask.any(axis=(1, 2))):
        columns, rows = np.flatnonzero(mask[view].any(axis=0)), np.flatnonzero(mask[view].any(axis=1))
        boxes[view] = columns[0], rows[0], columns[-1] + 1, rows[-1] + 1
    return boxes


def box_corners(vertices: Floats) -> Floats:
    """Return the corners (8, 3) of the axis-aligned box; bits 0, 1, 2 of row k select maximum x, y, z."""
    bits = (np.arange(8)[:, None] >> np.arange(3)) & 1
    return np.where(bits, vertices.max(axis=0), vertices.min(axis=0))


ALL: Final = "all"


def parse_channels(words: Iterable[str]) -> tuple[str, ...]:
    """Return the channels in fixed order; `all` stands for every channel; InputError if one is unknown."""
    wanted = {word.strip() for word in words if word.strip()}
    if unknown := sorted(wanted - {*EXTRA_CHANNELS, ALL}):
        meant = did_you_mean(unknown[0], EXTRA_CHANNELS)
        raise InputError(f"unknown channel {unknown[0]!r}; choose from {', '.join(EXTRA_CHANNELS)}, or {ALL}{meant}")
    return tuple(name for name in EXTRA_CHANNELS if name in wanted or ALL in wanted)


def occlusion_ratio(segmentation: NDArray[np.uint8], alone: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return the occluded share (V,) of the object's pixels; nan if the object is not in the picture.
    `segmentation` (V, H, W) labels the scene; `alone` (V, H, W) masks the object in a picture without other solids."""
    whole = alone.sum(axis=(1, 2)).astype(float)
    seen = (alone & (segmentation == OBJECT)).sum(axis=(1, 2))
    return np.where(whole > 0, 1.0 - seen / np.maximum(whole, 1.0), np.nan).astype(np.float32)
