"""Cameras that the caller gives: a JSON file with intrinsics, places, or both."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError, model_validator

from service.model.base import refusal
from service.model.errors import InputError
from service.model.transforms import Floats
from worker.rendering.cameras import look_at

#: Rotations of a file may be off by this: six digits are usual in JSON written by hand.
ROTATION_ERROR: Final = 1e-5

_Point = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]
_Row3 = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]
_Row4 = Annotated[list[FiniteFloat], Field(min_length=4, max_length=4)]


@dataclass(frozen=True)
class GivenCameras:
    """What is given; the rest is sampled or default."""

    intrinsics: Floats | None = None
    """(3, 3) K [px], one for all cameras."""
    extrinsics: Floats | None = None
    """(C, 4, 4) table to camera, the same in every scene."""
    width: int | None = None
    height: int | None = None


#: Default intrinsics, sampled places.
SAMPLED: Final = GivenCameras()


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class _Pinhole(_Model):
    fx: Annotated[FiniteFloat, Field(gt=0)]
    fy: Annotated[FiniteFloat, Field(gt=0)]
    cx: FiniteFloat
    cy: FiniteFloat


class _Camera(_Model):
    extrinsics: Annotated[list[_Row4], Field(min_length=4, max_length=4)] | None = None
    eye: _Point | None = None
    target: _Point | None = None

    @model_validator(mode="after")
    def _one_way(self) -> _Camera:
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
    """Cameras of a JSON file.

    All keys are optional: `width`, `height` [px]; `intrinsics`, a 3 x 3 matrix or `fx fy cx cy` [px]; `cameras`, a
    list of `{"extrinsics": 4 x 4}` (table to camera) or `{"eye": [x, y, z], "target": [x, y, z]}` (table frame [m]).

    Raises:
        InputError: the file cannot be read, or says something that no camera can be.
    """
    try:
        file = _File.model_validate_json(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from None
    except ValidationError as error:
        raise InputError(f"{path}: {refusal(error)}") from None
    extrinsics = None if file.cameras is None else np.stack([_place(path, k, c) for k, c in enumerate(file.cameras)])
    return GivenCameras(_matrix(path, file.intrinsics), extrinsics, file.width, file.height)


def _matrix(path: Path, given: _Pinhole | list[list[float]] | None) -> Floats | None:
    if given is None:
        return None
    if isinstance(given, _Pinhole):
        return np.array([[given.fx, 0, given.cx], [0, given.fy, given.cy], [0, 0, 1.0]])
    k = np.asarray(given, float)
    if k[0, 1] or k[1, 0] or k[2].tolist() != [0, 0, 1] or k[0, 0] <= 0 or k[1, 1] <= 0:
        raise InputError(
            f"{path}: intrinsics must read [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0 (no skew)"
        )
    return k


def _place(path: Path, number: int, camera: _Camera) -> Floats:
    if camera.extrinsics is None:
        eye, target = np.array(camera.eye, float), np.array(camera.target, float)
        if np.linalg.norm(target - eye) < 1e-9:
            raise InputError(f"{path}: camera {number} stands on its target")
        return look_at(eye, target)
    e = np.asarray(camera.extrinsics, float)
    u, _, v = np.linalg.svd(e[:3, :3])
    rotation = u @ v
    if (
        np.abs(rotation - e[:3, :3]).max() > ROTATION_ERROR
        or np.linalg.det(rotation) < 0
        or e[3].tolist() != [0, 0, 0, 1]
    ):
        raise InputError(f"{path}: extrinsics of camera {number} are no rigid motion (rotation, translation; 0 0 0 1)")
    # The nearest rotation: digits that the file lacks must not stretch what the camera sees.
    e[:3, :3] = rotation
    return e
