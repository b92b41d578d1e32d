"""The mean colour of a picture that colours a mesh."""

from __future__ import annotations

import io
import warnings
from typing import Final

import numpy as np
from PIL import Image

from service.model.transforms import Floats

#: Larger textures are not looked at [pixels].
MAX_PIXELS: Final = 2**24
#: What an unreadable picture may raise.
UNREADABLE: Final = (ValueError, OSError, SyntaxError, Image.DecompressionBombError)


def mean_colour(data: bytes) -> Floats:
    """(3,) sRGB mean of a PNG or JPEG, 0 .. 1.

    Raises:
        ValueError, OSError, SyntaxError, DecompressionBombError: it is too large, or no such picture (`UNREADABLE`).
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        with Image.open(io.BytesIO(data), formats=("PNG", "JPEG")) as opened:
            if opened.width * opened.height > MAX_PIXELS:
                raise ValueError("the image is too large")
            return np.asarray(opened.convert("RGB").resize((1, 1), Image.Resampling.BOX), float)[0, 0] / 255
