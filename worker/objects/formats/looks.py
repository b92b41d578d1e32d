"""Colours of meshes: materials of OBJ's libraries, and the mean colour of a picture."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable
from typing import Any, Final

import numpy as np

from service.model.transforms import Floats
from service.store.mesh_files import MAX_NAMES, reference_of

#: Materials that a library may have.
MAX_MATERIALS: Final = 1024
Nearby = Callable[[str], bytes | None]

"""Bytes of a file by the name that a mesh gives it; None: it is not among the hand's files."""


def nothing_nearby(reference: str) -> bytes | None:
    """For a mesh that stands alone."""
    return None


def read(data: bytes, nearby: Nearby) -> dict[bytes, Floats]:
    """(3,) sRGB of each material, 0 .. 1. A picture goes over the number; what cannot be read is left out."""
    found: dict[bytes, Floats] = {}
    name: bytes | None = None
    pictures = 0
    for line in data.splitlines():
        key, _, rest = line.strip().partition(b" ")
        if key == b"newmtl" and len(found) < MAX_MATERIALS:
            name = rest.strip()
        elif key == b"Kd" and name is not None:
            colour = _numbers(rest)
            if colour is not None:
                found.setdefault(name, colour)
        elif key.lower() == b"map_kd" and name is not None and pictures < MAX_NAMES:
            pictures += 1
            picture = colour_of(reference_of(rest), nearby)
            if picture is not None:
                found[name] = picture
    return found


def colour_of(reference: str, nearby: Nearby) -> Floats | None:
    """Mean colour of a picture beside the mesh; None where it is not there or cannot be read."""
    try:
        data = nearby(reference)
        return None if data is None else mean_colour(data)
    except UNREADABLE:
        return None


def _numbers(text: bytes) -> Floats | None:
    try:
        values = np.array(text.split()[:3], dtype="S40").astype(float)
    except ValueError:
        return None
    return np.clip(values, 0, 1) if len(values) == 3 and np.isfinite(values).all() else None


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
