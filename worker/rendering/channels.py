"""What a picture can show besides colour, depth and segmentation."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from service.model.domain import EXTRA_CHANNELS
from service.model.errors import InputError, did_you_mean
from service.model.pinhole import pixel_rays
from service.model.transforms import Floats
from worker.rendering.annotate import OBJECT

ALL: Final = "all"


def parse_channels(words: Iterable[str]) -> tuple[str, ...]:
    """Channels in their fixed order, without repeats; `all` stands for every one.

    Raises:
        InputError: a channel is unknown.
    """
    wanted = {word.strip() for word in words if word.strip()}
    if unknown := sorted(wanted - {*EXTRA_CHANNELS, ALL}):
        meant = did_you_mean(unknown[0], EXTRA_CHANNELS)
        raise InputError(f"unknown channel {unknown[0]!r}; choose of {', '.join(EXTRA_CHANNELS)}, or {ALL}{meant}")
    return tuple(name for name in EXTRA_CHANNELS if name in wanted or ALL in wanted)


def ray_distance(depth: NDArray[np.float32], k: Floats) -> NDArray[np.float32]:
    """(V, H, W) distance from the optical centre along the ray through each pixel's centre [m]; inf for nothing."""
    stretch = np.linalg.norm(pixel_rays(k, depth.shape[2], depth.shape[1]), axis=-1)
    return (depth * stretch).astype(np.float32)


def occlusion_ratio(segmentation: NDArray[np.uint8], alone: NDArray[np.bool_]) -> NDArray[np.float32]:
    """(V,) share of the object's pixels that something else hides; nan where the object is not in the picture.

    Args:
        segmentation: (V, H, W) labels of the whole scene.
        alone: (V, H, W) where the object would be seen with nothing else in the scene.
    """
    whole = alone.sum(axis=(1, 2)).astype(float)
    seen = (alone & (segmentation == OBJECT)).sum(axis=(1, 2))
    return np.where(whole > 0, 1.0 - seen / np.maximum(whole, 1.0), np.nan).astype(np.float32)
