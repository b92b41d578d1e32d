"""Colours of glTF materials: the base colour, times the mean of its texture where that lies in the file."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from service.model.transforms import Floats
from worker.objects.formats.pictures import UNREADABLE, mean_colour

_UNKNOWN: Final = np.full(3, np.nan)


def material_colour(document: dict[str, Any], binary: bytes, primitive: dict[str, Any]) -> Floats:
    """(3,) sRGB colour, 0 .. 1, of a primitive; NaN where none is stated or it cannot be read."""
    try:
        material = document["materials"][int(primitive["material"])]["pbrMetallicRoughness"]
        factor = np.array(material.get("baseColorFactor", (1.0, 1.0, 1.0, 1.0)), float)[:3].reshape(3)
        if "baseColorTexture" in material:
            colour = _of_linear(_to_linear(_mean(document, binary, material["baseColorTexture"])) * factor)
        elif "baseColorFactor" in material:
            colour = _of_linear(factor)
        else:
            return _UNKNOWN
    except (LookupError, TypeError, AttributeError, *UNREADABLE):
        # A picture says nothing of the shape: what cannot be read of it is left out.
        return _UNKNOWN
    return np.clip(colour, 0, 1) if np.isfinite(colour).all() else _UNKNOWN


def _mean(document: dict[str, Any], binary: bytes, texture: dict[str, Any]) -> Floats:
    """(3,) sRGB mean of an image in the file."""
    image = document["images"][int(document["textures"][int(texture["index"])]["source"])]
    view = document["bufferViews"][int(image["bufferView"])]
    start = int(view.get("byteOffset", 0))
    if start < 0 or view.get("buffer", 0) != 0:
        raise ValueError("the image is not in the file")
    return mean_colour(binary[start : start + int(view["byteLength"])])


def _to_linear(colour: Floats) -> Floats:
    return np.where(colour <= 0.04045, colour / 12.92, ((colour + 0.055) / 1.055) ** 2.4)


def _of_linear(colour: Floats) -> Floats:
    return np.where(colour <= 0.0031308, 12.92 * colour, 1.055 * np.maximum(colour, 0.0031308) ** (1 / 2.4) - 0.055)
