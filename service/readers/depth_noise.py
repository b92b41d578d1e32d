"""Noise models of depth cameras: axial noise, quantisation, edge bleeding, shadows and holes.

| effect | model | source |
| --- | --- | --- |
| axial noise | s(z, t) = a + b (z - c)^2 + e t^2 / (sqrt(z) (pi/2 - t)^2), t the angle of incidence | Nguyen |
| disparity noise | d = f B / z + N(0, p); the depth error grows as z^2 p / (f B) | Intel |
| quantisation | disparity or depth is a multiple of its step | Intel, Khoshelham, Microsoft |
| edge bleeding | depth comes from a pixel shifted by N(0, l + m t / (pi/2 - t)) | Handa, Nguyen |
| flying points | a pixel on an edge mixes both depths | Toelgyessy |
| shadows | regions hidden from the second eye or the projector | geometry; left-right check |
| holes | angles beyond 80 degrees; disparity beyond the search range; a random share | Nguyen, Intel |

Not modelled: materials (glass, mirrors, black), interference between cameras, multipath light, wrong calibration,
correlated errors of neighbouring pixels.

Sources: Nguyen, Izadi, Lovell 2012, Modeling Kinect Sensor Noise (3DIMPVT), eq. 1-4; Khoshelham, Elberink 2012,
Accuracy and Resolution of Kinect Depth Data (Sensors 12); Handa et al. 2014, A Benchmark for RGB-D Visual Odometry
(ICRA); Grunnet-Jepsen et al., Intel white papers on tuning and on subpixel linearity of the D400 series, and his
answers in librealsense issues 999 and 3904; Microsoft, Azure Kinect DK depth camera; Toelgyessy et al. 2021,
Evaluation of the Azure Kinect (Sensors 21), with the values used by BlenderProc.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.errors import InputError, choices_text
from graspd.service.model.pinhole import EDGE, back_project, surface_normals
from graspd.service.model.transforms import Floats

Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class DepthNoise:
    """Model of a depth camera. Lengths in pixels refer to the sensor and are scaled to the picture."""

    focal_px: float
    """Focal length of the sensor [px]."""
    baseline_m: float = 0.0
    """Distance from the eye to the second eye or the projector, along x; 0: none."""
    axial_m: float = 0.0
    """Axial noise at distances up to `axial_from_m` [m]."""
    axial_square: float = 0.0
    """Growth of the axial noise with the square of the distance beyond `axial_from_m` [1/m]."""
    axial_slope: float = 0.0
    """Linear growth of the axial noise with the distance beyond `axial_from_m`."""
    axial_from_m: float = 0.0
    axial_angle: float = 0.0
    """Growth of the axial noise with the angle of incidence [m^1.5]."""
    disparity_px: float = 0.0
    disparity_step_px: float = 0.0
    depth_step_m: float = 0.0
    lateral_px: float = 0.0
    lateral_angle_px: float = 0.0
    """Growth of `lateral_px` with t / (pi/2 - t)."""
    mixed: bool = False
    """Pixels on an edge mix the depths on both of its sides."""
    steepest_deg: float = 80.0
    """Largest angle of incidence at which the camera measures depth."""
    most_disparity_px: float = np.inf
    """Largest disparity of the search range."""
    dropout: float = 0.0
    """Share of pixels that are holes at random."""

    def sigma(self, depth: Floats, angle: Floats) -> Floats:
        """Return the standard deviation of depth [m] on a plane at `depth` [m] along the axis.

        `angle` is the angle of incidence [rad]; quantisation adds variance step^2 / 12.
        """
        total = self.axial_sigma(depth, angle) ** 2 + self.depth_step_m**2 / 12
        if self.baseline_m:
            per_pixel = depth**2 / (self.focal_px * self.baseline_m)
            total = total + per_pixel**2 * (self.disparity_px**2 + self.disparity_step_px**2 / 12)
        return np.sqrt(total)

    def axial_sigma(self, depth: Floats, angle: Floats) -> Floats:
        """Return the axial noise [m], without disparity noise and quantisation."""
        beyond = np.maximum(depth - self.axial_from_m, 0.0)
        found = self.axial_m + self.axial_slope * beyond + self.axial_square * beyond**2
        if self.axial_angle:
            found = found + self.axial_angle / np.sqrt(depth) * _steepness(angle) ** 2
        return np.asarray(found)

    def apply(
        self, depth: NDArray[Any], k: Floats, draw: np.random.Generator, *, angle: Floats | None = None
    ) -> Floats:
        """Simulate the camera's measurement of a depth picture; return depth (H, W) [m], nan: a hole.

        Args:
            depth: (H, W) true depth along the axis [m]; not finite: no surface.
            k: (3, 3) intrinsics of the picture [px].
            draw: random generator; equal states give equal pictures.
            angle: (H, W) angle of incidence [rad], if already computed.
        """
        true = np.where(np.isfinite(depth), np.asarray(depth, float), np.nan)
        angle = incidence_angle(true, k) if angle is None else angle
        scale = float(k[0, 0]) / self.focal_px
        with np.errstate(invalid="ignore", divide="ignore"):
            seen = _shift_pixels(true, scale * (self.lateral_px + self.lateral_angle_px * _steepness(angle)), draw)
            if self.mixed:
                seen = _mix_edges(seen, draw)
            seen = seen + self.axial_sigma(seen, angle) * draw.standard_normal(true.shape)
            if self.baseline_m:
                seen = self._quantize_disparity(seen, draw)
            if self.depth_step_m:
                seen = np.round(seen / self.depth_step_m) * self.depth_step_m
            return np.where(self._hole_mask(true, angle, k, draw), np.nan, seen)

    def _quantize_disparity(self, depth: Floats, draw: np.random.Generator) -> Floats:
        product = self.focal_px * self.baseline_m
        disparity = product / depth + self.disparity_px * draw.standard_normal(depth.shape)
        if self.disparity_step_px:
            disparity = np.round(disparity / self.disparity_step_px) * self.disparity_step_px
        return np.where(disparity > 0, product / disparity, np.nan)

    def _hole_mask(self, true: Floats, angle: Floats, k: Floats, draw: np.random.Generator) -> Bools:
        holes = np.degrees(angle) > self.steepest_deg
        if self.baseline_m:
            holes |= self.focal_px * self.baseline_m / true > self.most_disparity_px
            holes |= shadow_mask(true, float(k[0, 0]) * self.baseline_m)
        return np.asarray(holes | (draw.random(true.shape) < self.dropout))


def incidence_angle(depth: Floats, k: Floats) -> Floats:
    """Compute the angle (H, W) between surface normal and ray [rad]; 0 where the normal is undefined."""
    points = back_project(k, depth)
    with np.errstate(invalid="ignore"):
        cosine = np.abs(np.einsum("hwc,hwc->hw", surface_normals(points), points)) / np.linalg.norm(points, axis=-1)
    return np.arccos(np.clip(np.nan_to_num(cosine, nan=1.0), 0.0, 1.0))


def shadow_mask(depth: Floats, focal_baseline: float) -> Bools:
    """Find the pixels (H, W) hidden from the right eye; disparity [px] is `focal_baseline` [px m] / depth.

    Each pixel is projected into the other picture, which shows the nearest surface. A pixel is hidden if it is more
    than 1 px of disparity behind that surface (as in a left-right check), or outside the other picture.
    """
    height, width = depth.shape
    with np.errstate(divide="ignore"):
        disparity = np.nan_to_num(focal_baseline / depth, nan=0.0)
    at = np.arange(width) + 0.5 - disparity
    left = np.floor(at - 0.5).astype(int)
    rows = np.broadcast_to(np.arange(height)[:, None], left.shape)
    other = np.zeros((height, width))
    for column in (left, left + 1):  # A surface leaves no gap between adjacent pixels.
        inside = (column >= 0) & (column < width)
        np.maximum.at(other, (rows[inside], column[inside]), disparity[inside])
    nearest = np.clip(np.floor(at).astype(int), 0, width - 1)
    return (other[rows, nearest] > disparity + 1.0) | (at < 0)


def _steepness(angle: Floats) -> Floats:
    """Return t / (pi/2 - t), the angular term of Nguyen et al., constant beyond 89 degrees."""
    bounded = np.minimum(angle, np.radians(89.0))
    return np.asarray(bounded / (np.pi / 2 - bounded))


def _shift_pixels(depth: Floats, sigma_px: Floats, draw: np.random.Generator) -> Floats:
    height, width = depth.shape
    aside, down = (np.round(sigma_px * draw.standard_normal(depth.shape)).astype(int) for _ in range(2))
    rows = np.clip(np.arange(height)[:, None] + down, 0, height - 1)
    columns = np.clip(np.arange(width)[None, :] + aside, 0, width - 1)
    return depth[rows, columns]


def _mix_edges(depth: Floats, draw: np.random.Generator) -> Floats:
    found = depth
    for axis in (1, 0):
        last = depth.shape[axis] - 1
        after = np.take(depth, np.minimum(np.arange(last + 1) + 1, last), axis=axis)
        edge = np.abs(after - depth) > EDGE * depth
        share = draw.random(depth.shape)
        found = np.where(edge, (1 - share) * found + share * after, found)
    return found


NOISES: Final[Mapping[str, DepthNoise]] = MappingProxyType(
    {
        # Intel RealSense D435 at 848 x 480 and 90 degrees: f = 424 px; baseline 50 mm; subpixel 0.08 px (issue 3904),
        # steps of 1/32 px (subpixel linearity), 126 px searched (nearest 17 cm: issue 999), 99 % filled (data sheet).
        # Handa et al. shift by half a pixel.
        "stereo": DepthNoise(
            424, 0.05, disparity_px=0.08, disparity_step_px=1 / 32, lateral_px=0.5, most_disparity_px=126, dropout=0.01
        ),
        # Kinect v1: f = 585 px, 75 mm, steps of 1/8 px (Khoshelham); noise of Nguyen, eq. 2 and 4, lateral eq. 1.
        "structured_light": DepthNoise(
            585.0,
            0.075,
            axial_m=0.0012,
            axial_square=0.0019,
            axial_from_m=0.4,
            axial_angle=0.0001,
            disparity_step_px=1 / 8,
            lateral_px=0.8,
            lateral_angle_px=0.035,
        ),
        # Azure Kinect, narrow field: f = 504 px, millimetres (Microsoft); 0.5 mm to 0.5 m, 1 mm at 1 m (Toelgyessy).
        "tof": DepthNoise(504.0, axial_m=0.0005, axial_slope=0.001, axial_from_m=0.5, depth_step_m=0.001, mixed=True),
    }
)


def parse_depth_noise(given: str | DepthNoise | None) -> DepthNoise | None:
    if given is None or isinstance(given, DepthNoise):
        return given
    if given not in NOISES:
        raise InputError(f"there is no depth noise {given!r}; choose one of {choices_text(given, NOISES)}")
    return NOISES[given]
