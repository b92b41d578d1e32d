"""Pictures one after the other in one file: GIF, WebP or animated PNG."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from service.model.errors import InputError

#: How a file is written, by how its name ends. A GIF has 256 colours, and is many times as large as a WebP.
KINDS: Final[dict[str, dict[str, Any]]] = {
    ".gif": {"format": "GIF", "optimize": False, "disposal": 1},
    ".webp": {"format": "WEBP", "quality": 82, "method": 4},
    ".png": {"format": "PNG", "default_image": False},
}
#: Pictures whose colours make the palette of a GIF.
_PALETTE_OF: Final = 9


def animation_kind(suffix: str) -> str:
    """The suffix in small letters.

    Raises:
        InputError: no animation is written under it.
    """
    if (small := suffix.lower()) not in KINDS:
        raise InputError(f"an animation is written as {', '.join(KINDS)}, not as {suffix or 'a file without suffix'}")
    return small


def animation(pictures: NDArray[np.uint8], seconds: Sequence[float], suffix: str) -> bytes:
    """A film that begins anew when it ends.

    Args:
        pictures: (F, H, W, 3) sRGB.
        seconds: (F,) how long each is shown; files keep milliseconds, a GIF hundredths of a second.
        suffix: one of `KINDS`.

    Raises:
        InputError: no animation is written under this suffix.
    """
    kind = animation_kind(suffix)
    images = [Image.fromarray(picture) for picture in pictures]
    if kind == ".gif":
        images = _in_one_palette(pictures)
    buffer = io.BytesIO()
    durations = [round(1000 * shown) for shown in seconds]
    images[0].save(buffer, save_all=True, append_images=images[1:], duration=durations, loop=0, **KINDS[kind])
    return buffer.getvalue()


def _in_one_palette(pictures: NDArray[np.uint8]) -> list[Image.Image]:
    """Without dither, so what stands still stays the same from picture to picture."""
    some = np.unique(np.linspace(0, len(pictures) - 1, _PALETTE_OF).round().astype(int))
    palette = Image.fromarray(np.concatenate(pictures[some])).quantize(256, method=Image.Quantize.MEDIANCUT)
    return [Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
