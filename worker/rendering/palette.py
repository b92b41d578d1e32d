"""Random but pleasing materials and lights."""

from __future__ import annotations

import colorsys
from typing import Final

import numpy as np

from service.model.colours import Colour, hexadecimal, linear
from worker.rendering.kernels.shading import GRAIN, PLAIN, SPECKLE, TILES
from worker.rendering.scenery import Lamp, Look


def hsv(hue: float, saturation: float, value: float) -> Colour:
    """Linear RGB of hue, saturation, value in 0..1."""
    return linear(*colorsys.hsv_to_rgb(hue % 1.0, saturation, value))


_WOODS: Final = [("#b98a5a", "#8a5c34"), ("#d9b98c", "#b98f5e"), ("#7b5233", "#523320"), ("#a9978a", "#85736a")]
_STONES: Final = [("#c9c6c0", "#8f8b85"), ("#6f7478", "#45494d"), ("#d8d3c8", "#b5ad9f"), ("#86908a", "#5d6761")]
_CLOTHS: Final = ["#cfd3d6", "#e4ded2", "#9fb0b8", "#6d7f86", "#b7bda5", "#494f57", "#c9a98b"]


def table_look(rng: np.random.Generator) -> Look:
    """Wood, stone, tiles or a plain cloth."""
    kind = int(rng.integers(4))
    scale = float(rng.uniform(0.7, 1.5))
    if kind == 0:
        base, second = _WOODS[rng.integers(len(_WOODS))]
        return Look(hexadecimal(base), hexadecimal(second), GRAIN, scale, float(rng.uniform(0.45, 0.8)))
    if kind == 1:
        base, second = _STONES[rng.integers(len(_STONES))]
        return Look(hexadecimal(base), hexadecimal(second), SPECKLE, scale, float(rng.uniform(0.5, 0.8)))
    base = _CLOTHS[rng.integers(len(_CLOTHS))]
    if kind == 2:
        return Look(hexadecimal(base), hexadecimal("#8b8883"), TILES, scale, float(rng.uniform(0.45, 0.7)))
    return Look(hexadecimal(base), pattern=PLAIN, roughness=float(rng.uniform(0.7, 0.95)))


def object_look(rng: np.random.Generator) -> Look:
    """Glazed, painted, brushed or speckled, any hue."""
    hue, kind = float(rng.uniform()), int(rng.integers(4))
    base = hsv(hue, float(rng.uniform(0.3, 0.75)), float(rng.uniform(0.5, 0.9)))
    if kind == 0:
        return Look(base, roughness=float(rng.uniform(0.2, 0.35)))
    if kind == 1:
        return Look(hsv(hue, 0.15, 0.75), roughness=float(rng.uniform(0.35, 0.55)), metalness=1.0)
    if kind == 2:
        second = hsv(hue + float(rng.uniform(-0.08, 0.08)), 0.6, 0.45)
        return Look(base, second, SPECKLE, float(rng.uniform(1.0, 3.0)), float(rng.uniform(0.4, 0.7)))
    return Look(base, roughness=float(rng.uniform(0.5, 0.8)))


def lamp(rng: np.random.Generator) -> Lamp:
    """Warm to cool light of changing strength before a soft backdrop."""
    warmth, strength = float(rng.uniform(-1, 1)), float(rng.uniform(0.85, 1.15))
    tint = hsv(float(rng.uniform()), 0.12, float(rng.uniform(0.45, 0.8)))
    return Lamp(
        key=(strength * (1.5 + 0.15 * warmth), strength * 1.45, strength * (1.4 - 0.2 * warmth)),
        sky=(0.58 - 0.06 * warmth, 0.6, 0.64 + 0.06 * warmth),
        backdrop_low=(0.45 * tint[0], 0.45 * tint[1], 0.45 * tint[2]),
        backdrop_high=tint,
    )
