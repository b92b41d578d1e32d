"""The mean colour of a picture that colours a mesh."""

from __future__ import annotations

import io
import warnings
from typing import Any, Final

import numpy as np

from service.model.transforms import Floats

#: Larger textures are not looked at [pixels].
MAX_PIXELS: Final = 2**24
#: What an unreadable picture may raise.
UNREADABLE: Final = (ValueError, OSError, SyntaxError)


def mean_colour(data: bytes) -> Floats:
    """(3,) sRGB mean of a PNG or JPEG, 0 .. 1.

    Raises:
        ValueError, OSError, SyntaxError: it is too large, or no such picture (`UNREADABLE`).
    """
    from PIL import Image  # few meshes have pictures, and every process reads meshes

    try:
        return _mean_colour(Image, data)
    except Image.DecompressionBombError as error:
        raise ValueError(str(error)) from error


def _mean_colour(image: Any, data: bytes) -> Floats:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", image.DecompressionBombWarning)
        with image.open(io.BytesIO(data), formats=("PNG", "JPEG")) as opened:
            if opened.width * opened.height > MAX_PIXELS:
                raise ValueError("the image is too large")
            return np.asarray(opened.convert("RGB").resize((1, 1), image.Resampling.BOX), float)[0, 0] / 255
