"""Pinhole cameras: poses, projection, and cameras from a user's JSON file.

Camera frame: x right, y down, z forward (OpenCV). Extrinsics E = [R | t] map table to camera: x_camera = R x + t. Pixel
(column i, row j) covers [i, i + 1) x [j, j + 1): its centre is (i + 0.5, j + 0.5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError, model_validator

from graspd.service.model.base import first_error
from graspd.service.model.errors import InputError
from graspd.service.model.pinhole import pixel_rays
from graspd.service.model.transforms import Floats

FIELD_OF_VIEW: Final = np.radians(40.0)
BASELINE_M: Final = 0.06
ELEVATION: Final = (np.radians(18.0), np.radians(62.0))  # elevation of a sampled camera above the table [rad]
FILL: Final = (0.7, 1.0)  # share of the smaller field of view that the object's bounding ball fills
NEAREST_M: Final = 0.25  # least distance from the object [m]: below it, a stereo picture may cut the object off
AIM_JITTER: Final = 0.15  # largest offset of the aim from the object's centre along each axis, in bounding radii


@dataclass(frozen=True)
class Cameras:
    """V cameras with a common picture size and K."""

    width: int
    height: int
    intrinsics: Floats  # (3, 3) [px]
    extrinsics: Floats  # (V, 4, 4) table to camera

    def __len__(self) -> int:
        return len(self.extrinsics)

    @property
    def centre(self) -> Floats:
        """(V, 3) optical centres in the table frame [m]."""
        rotation, translation = self.extrinsics[:, :3, :3], self.extrinsics[:, :3, 3]
        return -np.einsum("vji,vj->vi", rotation, translation)

    def project(self, points: Floats) -> tuple[Floats, Floats]:
        """Return pixel coordinates (V, P, 2) and depths (V, P) of table-frame points (P, 3) or (V, P, 3)."""
        points = np.broadcast_to(points, (len(self), *np.shape(points)[-2:]))
        camera = np.einsum("vij,vpj->vpi", self.extrinsics[:, :3, :3], points) + self.extrinsics[:, None, :3, 3]
        image = camera @ self.intrinsics.T
        return image[..., :2] / image[..., 2:], camera[..., 2]

    def unproject(self, depth: Floats) -> Floats:
        """Return table-frame points (V, H, W, 3) of forward depths (V, H, W) at pixel centres."""
        camera = pixel_rays(self.intrinsics, self.width, self.height) * np.asarray(depth, float)[..., None]
        offset = camera - self.extrinsics[:, None, None, :3, 3]
        return np.einsum("vji,vhwj->vhwi", self.extrinsics[:, :3, :3], offset)


def intrinsics(width: int, height: int, field_of_view: float = FIELD_OF_VIEW) -> Floats:
    """Return K (3, 3) with square pixels and a centred principal point.
    `field_of_view` [rad] spans the picture's height."""
    focal = 0.5 * height / np.tan(0.5 * field_of_view)
    return np.array([[focal, 0, 0.5 * width], [0, focal, 0.5 * height], [0, 0, 1.0]])


def inscribed_field_of_view(k: Floats, width: int, height: int) -> float:
    """Return the opening angle of the widest cone around the optical axis within the picture [rad].
    Raises InputError: the principal point lies outside the picture."""
    slopes = [k[0, 2] / k[0, 0], (width - k[0, 2]) / k[0, 0], k[1, 2] / k[1, 1], (height - k[1, 2]) / k[1, 1]]
    if min(slopes) <= 0:
        raise InputError(
            f"the principal point ({k[0, 2]:g}, {k[1, 2]:g}) lies outside the picture of {width} x {height} px, so no "
            "camera can be aimed; give the cameras' poses too"
        )
    return float(2 * np.arctan(min(slopes)))


def look_at(eye: Floats, target: Floats, up: Sequence[float] | Floats = (0.0, 0.0, 1.0)) -> Floats:
    """Return extrinsics (4, 4) of a camera at `eye` that looks at `target`; by default, z is up."""
    forward = np.asarray(target, float) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-9:
        right = np.array([1.0, 0.0, 0.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, -rotation @ eye
    return matrix


def distance_to_fill(radius: float, field_of_view: float, fill: float) -> float:
    """Return the distance at which a ball of this radius fills the share `fill` of the field of view [m]."""
    return radius / float(np.sin(0.5 * fill * field_of_view))


def direction_of(azimuth: float, elevation: float) -> Floats:
    """Return the unit vector (3,) of an azimuth and an elevation [rad]."""
    flat = np.cos(elevation)
    return np.array([np.cos(azimuth) * flat, np.sin(azimuth) * flat, np.sin(elevation)])


def sample_hemisphere(
    centre: Floats, radius: float, *, views: int, field_of_view: float, rng: np.random.Generator
) -> list[Floats]:
    """Sample extrinsics of cameras on a hemisphere around a ball that fills the field of view [rad].
    Azimuths are stratified, one per sector of 360 / views degrees; elevations are uniform in area in `ELEVATION`."""
    turn = rng.uniform(0, 2 * np.pi)
    extrinsics = []
    for view in range(views):
        azimuth = turn + 2 * np.pi * (view + rng.uniform(0.1, 0.9)) / views
        elevation = np.arcsin(rng.uniform(np.sin(ELEVATION[0]), np.sin(ELEVATION[1])))
        distance = max(NEAREST_M + radius, distance_to_fill(radius, field_of_view, rng.uniform(*FILL)))
        aim = centre + radius * AIM_JITTER * rng.uniform(-1, 1, 3)
        extrinsics.append(look_at(centre + distance * direction_of(azimuth, elevation), aim))
    return extrinsics


def stereo_pair(extrinsics: Floats, baseline: float) -> tuple[Floats, Floats]:
    """Return left and right eye of a rectified pair, `baseline` [m] apart along the camera's x axis."""
    left, right = extrinsics.copy(), extrinsics.copy()
    left[0, 3] += 0.5 * baseline
    right[0, 3] -= 0.5 * baseline
    return left, right


ROTATION_ERROR: Final = 1e-5  # tolerance of rotations in a file: JSON written by hand usually has six digits

_Row3 = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]
_Row4 = Annotated[list[FiniteFloat], Field(min_length=4, max_length=4)]


@dataclass(frozen=True)
class GivenCameras:
    """Given cameras; missing values are sampled or default."""

    intrinsics: Floats | None = None  # (3, 3) K [px], common to all cameras
    extrinsics: Floats | None = None  # (C, 4, 4) table to camera, the same in every scene
    width: int | None = None
    height: int | None = None


SAMPLED: Final = GivenCameras()  # default intrinsics, sampled poses


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class _Pinhole(_Model):
    fx: Annotated[FiniteFloat, Field(gt=0)]
    fy: Annotated[FiniteFloat, Field(gt=0)]
    cx: FiniteFloat
    cy: FiniteFloat


class _Camera(_Model):
    extrinsics: Annotated[list[_Row4], Field(min_length=4, max_length=4)] | None = None
    eye: _Row3 | None = None
    target: _Row3 | None = None

    @model_validator(mode="after")
    def _require_one_placement(self) -> _Camera:
        looks = self.eye is not None and self.target is not None
        if (self.extrinsics is not None) == looks or (self.eye is None) != (self.target is None):
            raise ValueError("a camera has either extrinsics or eye and target")
        return self


class _File(_Model):
    width: Annotated[int, Field(ge=16, le=4096)] | None = None
    height: Annotated[int, Field(ge=16, le=4096)] | None = None
    intrinsics: _Pinhole | Annotated[list[_Row3], Field(min_length=3, max_length=3)] | None = None
    cameras: Annotated[list[_Camera], Field(min_length=1, max_length=4096)] | None = None


def read_cameras(path: Path) -> GivenCameras:
    """Load cameras from a JSON file; all keys are optional.
    `width`, `height` [px]. `intrinsics`: a 3 x 3 matrix or `fx fy cx cy` [px]. `cameras`: a list of `{"extrinsics": 4 x
    4}` (table to camera) or `{"eye": [x, y, z], "target": [x, y, z]}` (table frame [m]). Raises InputError: the file
    cannot be read, or describes no possible camera."""
    try:
        file = _File.model_validate_json(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from None
    except ValidationError as error:
        raise InputError(f"{path}: {first_error(error)}") from None
    extrinsics = (
        None if file.cameras is None else np.stack([_camera_extrinsics(path, k, c) for k, c in enumerate(file.cameras)])
    )
    return GivenCameras(_intrinsic_matrix(path, file.intrinsics), extrinsics, file.width, file.height)


def _intrinsic_matrix(path: Path, given: _Pinhole | list[list[float]] | None) -> Floats | None:
    if given is None:
        return None
    if isinstance(given, _Pinhole):
        return np.array([[given.fx, 0, given.cx], [0, given.fy, given.cy], [0, 0, 1.0]])
    k = np.asarray(given, float)
    if k[0, 1] or k[1, 0] or k[2].tolist() != [0, 0, 1] or k[0, 0] <= 0 or k[1, 1] <= 0:
        raise InputError(f"{path}: intrinsics must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0 (no skew)")
    return k


def _camera_extrinsics(path: Path, number: int, camera: _Camera) -> Floats:
    if camera.extrinsics is None:
        eye, target = np.array(camera.eye, float), np.array(camera.target, float)
        if np.linalg.norm(target - eye) < 1e-9:
            raise InputError(f"{path}: camera {number} has its eye at its target")
        return look_at(eye, target)
    e = np.asarray(camera.extrinsics, float)
    u, _, v = np.linalg.svd(e[:3, :3])
    rotation = u @ v
    error = np.abs(rotation - e[:3, :3]).max()
    if error > ROTATION_ERROR or np.linalg.det(rotation) < 0 or e[3].tolist() != [0, 0, 0, 1]:
        raise InputError(f"{path}: extrinsics of camera {number} are no rigid motion (rotation, translation; 0 0 0 1)")
    e[:3, :3] = rotation  # rounded digits in the file must not distort the picture
    return e
