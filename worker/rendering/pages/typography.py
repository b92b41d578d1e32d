"""Text and colour for pictures that people read."""

from __future__ import annotations

import io
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

PAPER: Final = (250, 250, 249)
INK: Final = (28, 32, 36)
QUIET: Final = (122, 128, 134)
RULE: Final = (222, 224, 226)
ACCENT: Final = (31, 132, 126)

#: Anchors of the depth colours, near to far: even steps of lightness from light to dark, hue from sand to indigo.
_DEPTH: Final = np.array(
    [
        [252, 243, 207],
        [250, 206, 130],
        [243, 158, 93],
        [220, 103, 92],
        [173, 63, 107],
        [113, 43, 109],
        [54, 32, 84],
        [16, 16, 40],
    ],
    float,
)


@lru_cache(maxsize=16)
def font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Pillow's own scalable font."""
    return ImageFont.load_default(size)


def text(
    draw: ImageDraw.ImageDraw, at: tuple[float, float], words: str, size: int, fill: tuple[int, int, int]
) -> float:
    """Writes words with the baseline at `at`; `^2` is set as an exponent. Returns the x where they end."""
    x, y = at
    for k, part in enumerate(words.split("^")):
        if k and part:
            exponent, part = part[0], part[1:]
            small = font(round(0.62 * size))
            draw.text((x + 1, y - 0.38 * size), exponent, font=small, fill=fill, anchor="ls")
            x += 1 + small.getlength(exponent)
        draw.text((x, y), part, font=font(size), fill=fill, anchor="ls")
        x += font(size).getlength(part)
    return x


def depth_colours(depth: NDArray[np.float32], near: float, far: float) -> NDArray[np.uint8]:
    """(..., 3) colours of depths: light is near, dark is far, grey is nothing."""
    t = np.clip((np.where(np.isfinite(depth), depth, near) - near) / max(far - near, 1e-9), 0, 1) * (len(_DEPTH) - 1)
    low = np.minimum(t.astype(int), len(_DEPTH) - 2)
    mixed = _DEPTH[low] + (t - low)[..., None] * (_DEPTH[low + 1] - _DEPTH[low])
    return np.where(np.isfinite(depth)[..., None], mixed, 214.0).round().astype(np.uint8)


def png(image: Image.Image) -> bytes:
    """PNG bytes."""
    buffer = io.BytesIO()
    image.save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


def with_palette(page: bytes) -> bytes:
    """The same PNG in 256 colours: a third of the bytes, for pages of documents."""
    return png(Image.open(io.BytesIO(page)).convert("RGB").quantize(256, method=Image.Quantize.MEDIANCUT))
