"""What stands before the cameras: solids, materials, lights; and what a shot asks for and gives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.model.transforms import Floats
from worker.rendering.kernels.shading import PLAIN


@dataclass(frozen=True)
class Solid:
    """A triangle mesh with normals per face corner."""

    vertices: Floats
    faces: NDArray[np.int32]
    corner_normals: Floats


@dataclass(frozen=True)
class Box:
    """A box centred at its frame's origin: traced in closed form, cheaper than a mesh."""

    size: tuple[float, float, float]


@dataclass(frozen=True)
class Look:
    """Material of one solid. Colours are linear RGB."""

    base: tuple[float, float, float]
    second: tuple[float, float, float] = (0.0, 0.0, 0.0)
    pattern: int = PLAIN
    scale: float = 1.0
    roughness: float = 0.5
    metalness: float = 0.0


@dataclass(frozen=True)
class Lamp:
    """Light of one world. Colours are linear RGB radiance."""

    key: tuple[float, float, float] = (1.7, 1.6, 1.5)
    sky: tuple[float, float, float] = (0.55, 0.6, 0.68)
    ground: tuple[float, float, float] = (0.16, 0.14, 0.12)
    backdrop_low: tuple[float, float, float] = (0.24, 0.26, 0.29)
    backdrop_high: tuple[float, float, float] = (0.6, 0.65, 0.7)


@dataclass(frozen=True)
class Pictures:
    """What V cameras see."""

    rgb: NDArray[np.uint8]
    """(V, H, W, 3) sRGB"""
    depth: NDArray[np.float32]
    """(V, H, W) along the optical axis [m]; inf: nothing."""
    shape: NDArray[np.int64]
    """(V, H, W) index of the solid seen through the pixel's centre; -1: nothing."""
    normal: NDArray[np.float32] | None = None
    """(V, H, W, 3) unit shading normal in the world's frame, zero where nothing is; only if the shot asks for it."""


@dataclass(frozen=True)
class Shot:
    """Which world each camera looks into, and how the light falls."""

    world: NDArray[np.int32]
    """(V,)"""
    extrinsics: Floats
    """(V, 4, 4) world to camera: x right, y down, z forward."""
    intrinsics: Floats
    width: int
    height: int
    samples: int
    toward_lamp: Floats
    """(3,) unit; in the frame in which worlds are turned by `turn`."""
    turn: Floats
    """(worlds,) angle about z by which each world is turned under the lamp [rad]."""
    lamps: Sequence[Lamp]
    """One per world."""
    normals: bool = False
    """Whether the pictures come with normals."""
    shaded: bool = True
    """False: rays are traced but no colour is made of them. What that costs is the price of the bare ray tracer."""
