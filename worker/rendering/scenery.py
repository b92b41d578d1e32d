"""Data of renders: solids, supports as boxes, materials, lights; requests and results of a shot."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.scene_spec import Box as BoxSupport
from graspd.service.model.scene_spec import HalfSpace
from graspd.service.model.transforms import Floats, compose, invert, quat_from_axis_angle, quat_rotate
from graspd.worker.rendering.kernels.shading import PLAIN


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
class Appearance:
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
    """Pictures of V cameras."""

    rgb: NDArray[np.uint8]  # (V, H, W, 3) sRGB
    depth: NDArray[np.float32]  # (V, H, W) along the optical axis [m]; inf without a surface
    shape: NDArray[np.int64]  # (V, H, W) index of the solid at the pixel's centre; -1 without one
    normal: NDArray[np.float32] | None = None
    """(V, H, W, 3) unit shading normal in the world's frame, zero without a surface; only if requested."""


@dataclass(frozen=True)
class CameraShot:
    """Cameras with their worlds, and the light."""

    world: NDArray[np.int32]  # (V,)
    extrinsics: Floats  # (V, 4, 4) world to camera: x right, y down, z forward
    intrinsics: Floats
    width: int
    height: int
    samples: int
    toward_lamp: Floats  # (3,) unit; in the frame in which worlds are turned by `turn`
    turn: Floats  # (worlds,) angle about z by which each world is turned under the lamp [rad]
    lamps: Sequence[Lamp]  # one per world
    normals: bool = False
    shaded: bool = True  # False: rays without shading, to measure the cost of the bare ray tracer


Supports = Sequence[HalfSpace | BoxSupport]

TABLE_SIZE: Final = (1.2, 0.9, 0.04)  # size [m] of the slab that shows a half-space: its top is the plane
TABLE: Final = (HalfSpace(),)  # default support of objects
_FAR_M: Final = 0.35  # distance [m] along a plane from origin to object above which the slab is centred at the object


def slabs(supports: Supports) -> list[Box]:
    """Return a box for each support."""
    return [Box(s.size if isinstance(s, BoxSupport) else TABLE_SIZE) for s in supports]


def slab_poses(supports: Supports, middle: Floats, yaw: float) -> Floats:
    """Return poses (P, 7) of the boxes of `slabs` in the scene frame, for an object at `middle` (3,).
    `yaw` turns half-spaces' slabs about their normal [rad]."""
    poses = [_box_pose(s) if isinstance(s, BoxSupport) else _slab_pose(s, middle, yaw) for s in supports]
    return np.array(poses).reshape(-1, 7)


def _box_pose(box: BoxSupport) -> Floats:
    pose = np.asarray(box.pose, float)
    pose[3:] /= np.linalg.norm(pose[3:])
    return pose


def _slab_pose(plane: HalfSpace, middle: Floats, yaw: float) -> Floats:
    normal = np.asarray(plane.normal, float)
    length = float(np.linalg.norm(normal))
    normal, offset = normal / length, plane.offset / length
    beside = middle - (normal @ middle) * normal
    about = np.zeros(3) if np.linalg.norm(beside) < _FAR_M else beside
    tilt = np.arctan2(np.hypot(normal[0], normal[1]), normal[2])
    axis = np.array([-normal[1], normal[0], 0.0])
    axis = axis / np.linalg.norm(axis) if np.linalg.norm(axis) > 1e-9 else np.array([1.0, 0, 0])
    at = about + (offset - normal @ about) * normal
    up = np.concatenate([at, quat_from_axis_angle(axis, np.asarray(tilt))])
    return compose(up, np.array([0, 0, -0.5 * TABLE_SIZE[2], np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]))


def visible_share(supports: Supports, eye: Floats, points: Floats) -> float:
    """Return the share of points (P, 3) that no support hides from an eye (3,)."""
    hidden = np.zeros(len(points), bool)
    for support in supports:
        if isinstance(support, HalfSpace):
            # Points on the plane are visible; an eye below it sees nothing.
            normal, length = np.asarray(support.normal), float(np.linalg.norm(support.normal))
            hidden |= bool(normal @ eye < support.offset - 1e-9 * length)
        else:
            hidden |= _crossing_mask(eye, points, _box_pose(support), np.asarray(support.size) / 2)
    return 1.0 - float(hidden.mean())


def _crossing_mask(
    eye: Floats, points: Floats, pose: Floats, half: Floats
) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Return a mask (P,) of points whose line to the eye crosses a box (Kay and Kajiya 1986)."""
    inside = invert(pose)
    start = quat_rotate(inside[3:], eye) + inside[:3]
    along = quat_rotate(inside[3:], points) + inside[:3] - start
    step = np.where(np.abs(along) < 1e-12, 1e-12, along)
    first, second = (-half - start) / step, (half - start) / step
    enter = np.minimum(first, second).max(axis=1)
    leave = np.maximum(first, second).min(axis=1)
    # Points on a support are not behind it.
    return np.asarray((enter < leave) & (leave > 0) & (enter < 1 - 1e-3))
