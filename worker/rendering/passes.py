"""What each pass of a picture adds: where its rays go through the pixels, and where its light comes from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from worker.rendering.cameras import Floats

#: Radius of the lamp's disc seen from the table [rad].
LAMP_RADIUS: Final = np.radians(3.5)
#: Sine of the elevation above which the sky shines.
SKY_EDGE: Final = 0.35
_GOLDEN: Final = np.pi * (3.0 - np.sqrt(5.0))
#: Steps of the R2 sequence (Roberts 2018): few points, evenly spread.
_R2: Final = np.array([0.7548776662466927, 0.5698402909980532])


@dataclass(frozen=True)
class LightPass:
    """One ray through every pixel, one directional light."""

    shift: tuple[float, float]
    """Of the ray from the pixel's centre [px]."""
    toward: Floats
    """(3,) unit direction to the light."""
    lamp_weight: float
    """Weights that make the mean over all passes one lamp and one sky."""
    sky_weight: float


def light_passes(samples: int, toward_lamp: Floats) -> list[LightPass]:
    """Passes by turns from the lamp's disc and from the sky; pass 0 goes through the pixel centres."""
    lamp_passes, sky_passes = (samples + 1) // 2, samples // 2
    # An open horizontal surface receives 1 from the whole sky.
    sky = 2.0 / (1.0 + SKY_EDGE) * samples / max(1, sky_passes)
    passes = []
    for k in range(samples):
        across, down = (0.5 + k * _R2) % 1.0 - 0.5
        shift = (float(across), float(down))
        if k % 2 == 0:
            toward = _on_disc(toward_lamp, k // 2, lamp_passes)
            passes.append(LightPass(shift, toward, samples / lamp_passes, 0.0))
        else:
            passes.append(LightPass(shift, _on_sky(k // 2, sky_passes), 0.0, sky))
    return passes


def _on_disc(axis: Floats, k: int, count: int) -> Floats:
    radius, angle = LAMP_RADIUS * np.sqrt((k + 0.5) / count), _GOLDEN * k
    side = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    direction = axis + radius * (np.cos(angle) * side + np.sin(angle) * np.cross(axis, side))
    return np.asarray(direction / np.linalg.norm(direction))


def _on_sky(k: int, count: int) -> Floats:
    # Uniform over the sky above the horizon haze: low lights would draw long streaks.
    height, angle = 1.0 - (1.0 - SKY_EDGE) * (k + 0.5) / count, _GOLDEN * k
    level = np.sqrt(1.0 - height**2)
    return np.array([level * np.cos(angle), level * np.sin(angle), height])
