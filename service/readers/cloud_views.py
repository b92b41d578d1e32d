"""One view of a cloud: its pixels as points, perfect or as a depth camera would tell them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from service.model import transforms
from service.model.pinhole import back_project, fitted_normals, surface_normals
from service.readers.depth_noise import DepthNoise, incidence

Array = NDArray[Any]
Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

COLUMNS: Final = ("image/depth", "image/segmentation", "camera/intrinsics", "camera/extrinsics")
_OBJECT: Final = 2
#: Planes are fitted to noisy points in windows of 7 x 7 pixels, which are let reach this many deviations in depth.
_RADIUS: Final = 3
_DEVIATIONS: Final = 4.0
#: Steepest surface within such a window: its depth grows by this many times the way across.
_SLOPE: Final = 3.0


@dataclass(frozen=True)
class CloudView:
    """The columns `COLUMNS` of one picture, and what a camera makes of its depth."""

    columns: Mapping[str, Array]
    noise: DepthNoise | None
    seen: Floats
    """(H, W) depth as it is told [m]; not finite: nothing."""
    angle: Floats | None
    """(H, W) of incidence [rad]; None: without noise nobody asks."""

    @classmethod
    def of(cls, columns: Mapping[str, Array], noise: DepthNoise | None, draw: np.random.Generator) -> CloudView:
        """A picture; `draw` decides the noise."""
        depth = np.asarray(columns["image/depth"], float)
        k = np.asarray(columns["camera/intrinsics"], float)
        if noise is None:
            return cls(columns, noise, depth, None)
        angle = incidence(depth, k)
        return cls(columns, noise, noise.apply(depth, k, draw, angle=angle), angle)

    def pixels(self, *, whole: bool) -> tuple[Ints, Ints]:
        """Rows and columns of what is seen of the object, or of the whole scene."""
        labels = self.columns["image/segmentation"]
        wanted = np.isfinite(self.seen) & ((labels > 0) if whole else (labels == _OBJECT))
        if self.noise is None:  # a pixel without neighbours has no normal
            wanted &= np.isfinite(self._normals[..., 0])
        row, column = np.nonzero(wanted & np.isfinite(self._true[..., 2]))
        return row, column

    def points(self, row: Ints, column: Ints) -> Floats:
        """(P, 3) of some pixels, in the frame of the table [m]."""
        return transforms.apply(self._back, self._points[row, column])

    def true_points(self, row: Ints, column: Ints) -> Floats:
        """The same without noise."""
        return transforms.apply(self._back, self._true[row, column])

    def normals(self, row: Ints, column: Ints) -> Floats:
        """(P, 3) unit normals of some pixels, toward the camera, in the frame of the table."""
        if self.noise is None or self.angle is None:
            return transforms.quat_rotate(self._back[3:], self._normals[row, column])
        z = self._points[row, column, 2]
        gap = _SLOPE * _RADIUS * z / self._k[0, 0] + _DEVIATIONS * self.noise.sigma(z, self.angle[row, column])
        fitted = fitted_normals(self._points, row, column, radius=_RADIUS, gap_m=gap)
        return transforms.quat_rotate(self._back[3:], fitted)

    def is_object(self, row: Ints, column: Ints) -> NDArray[np.bool_]:
        """(P,) whether pixels show the object."""
        return np.asarray(self.columns["image/segmentation"][row, column] == _OBJECT)

    @property
    def extrinsics(self) -> Floats:
        """(4, 4) table to camera."""
        return np.asarray(self.columns["camera/extrinsics"], float)

    @property
    def _k(self) -> Floats:
        return np.asarray(self.columns["camera/intrinsics"], float)

    @cached_property
    def _back(self) -> Floats:
        return transforms.invert(transforms.pose_from_matrix(self.extrinsics))

    @cached_property
    def _true(self) -> Floats:
        return back_project(self._k, self.columns["image/depth"])

    @cached_property
    def _points(self) -> Floats:
        return self._true if self.noise is None else back_project(self._k, self.seen)

    @cached_property
    def _normals(self) -> Floats:
        return surface_normals(self._true)
