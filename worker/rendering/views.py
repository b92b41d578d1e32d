"""Views of scenes: pictures of an object on a table with everything that a network is taught about them."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from service.errors import InputError
from worker.objects.model import Floats, ObjectModel
from worker.rendering.annotate import BACKGROUND, OBJECT, TABLE, box_corners, in_camera, loose_boxes, tight_boxes
from worker.rendering.cameras import BASELINE_M, Cameras, intrinsics, sample_hemisphere, stereo_pair
from worker.rendering.palette import lamp, object_look, table_look
from worker.rendering.scenery import Box, Shot, Solid
from worker.rendering.stage import Stage
from worker.transforms import apply

#: The table: a slab whose top is z = 0 [m].
TABLE_SIZE: Final = (1.2, 0.9, 0.04)
#: Passes per picture; half of them light the scene with the lamp, half with the sky.
SAMPLES: Final = 12
_KEPT_STAGES: Final = 4
_stages: OrderedDict[tuple[str, int, int, int, str], Stage] = OrderedDict()

Progress = Callable[[float, float, str], None]


def render(
    obj: ObjectModel,
    object_pose: Floats,
    *,
    views: int,
    stereo: bool,
    width: int,
    height: int,
    seed: int,
    device: str,
    progress: Progress | None = None,
    cancelled: Callable[[], bool] = lambda: False,
    baseline_m: float = BASELINE_M,
    samples: int = SAMPLES,
) -> dict[str, NDArray[np.generic]]:
    """Pictures of every scene from sampled cameras, all in one launch per pass.

    Args:
        obj: the object.
        object_pose: (S, 7) rest poses in the table frame.
        views: camera placements per scene.
        stereo: a rectified left and right picture per placement.
        width, height: picture size [px].
        seed: of cameras, materials and lights; same seed, same pixels. Scene s depends on (seed, s) alone.
        device: Warp device, such as `cpu` or `cuda:0`.
        progress: told about passes done.
        cancelled: asked before each pass.
        baseline_m: distance of the eyes.
        samples: rays per pixel.

    Returns:
        The datasets of a views shard, V = S * views * (2 if stereo else 1) pictures: scene by scene, placement by
        placement, left before right. Labels come from the ray through the pixel's centre; the table is a surface
        like any other in `image/depth`.

    Raises:
        InputError: a count or size is out of range.
        TaskCancelled: `cancelled()` answered True.
    """
    poses = np.asarray(object_pose, float).reshape(-1, 7)
    if views < 1 or width < 1 or height < 1 or samples < 2 or len(poses) == 0:
        raise InputError(
            f"rendering needs at least one scene, view and pixel and two samples; "
            f"got {len(poses)} scenes, {views} views, {width} x {height} px, {samples} samples"
        )
    scenes = [
        _Scene(obj, pose, views, width / height, np.random.default_rng([seed, s])) for s, pose in enumerate(poses)
    ]
    eyes = 2 if stereo else 1
    extrinsics = np.concatenate([_eyes(scene.extrinsics, baseline_m if stereo else None) for scene in scenes])
    cameras = Cameras(width, height, intrinsics(width, height), extrinsics)
    world = np.repeat(np.arange(len(poses), dtype=np.int32), views * eyes)
    stage = _stage(obj, len(poses), device)
    stage.place(np.stack([scene.poses for scene in scenes]), [scene.looks for scene in scenes])
    shot = Shot(
        world=world, extrinsics=extrinsics, intrinsics=cameras.intrinsics, width=width, height=height,
        samples=samples, toward_lamp=_toward_lamp(np.random.default_rng([seed, 2**31])),
        turn=np.array([scene.turn for scene in scenes]), lamps=[scene.lamp for scene in scenes],
    )  # fmt: skip
    pictures = stage.shoot(shot, tick=_ticker(progress, len(world)), cancelled=cancelled)
    eye = np.tile(np.array([1, 2] if stereo else [0], np.uint8), len(poses) * views)
    segmentation = np.array([BACKGROUND, TABLE, OBJECT], np.uint8)[pictures.shape + 1]
    return {
        "camera/intrinsics": np.repeat(cameras.intrinsics[None], len(world), axis=0),
        "camera/extrinsics": extrinsics,
        "camera/scene_index": world,
        "camera/eye": eye,
        "camera/stereo_baseline_m": np.full(len(world), baseline_m if stereo else 0.0),
        "image/rgb": pictures.rgb,
        "image/depth": pictures.depth,
        "image/segmentation": segmentation,
        "box/bounding_box_2d_tight": tight_boxes(segmentation),
        "box/bounding_box_2d_loose": loose_boxes(cameras, apply(poses[world][:, None], obj.vertices)),
        "box/bounding_box_3d": in_camera(cameras, apply(poses[world][:, None], box_corners(obj.vertices))).astype(
            np.float32
        ),
    }


class _Scene:
    """What the seed decides about one scene."""

    def __init__(self, obj: ObjectModel, pose: Floats, views: int, aspect: float, rng: np.random.Generator) -> None:
        points = apply(pose, obj.hull_vertices)
        centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
        radius = float(np.linalg.norm(points - centre, axis=1).max())
        self.extrinsics = sample_hemisphere(centre, radius, views=views, aspect=aspect, rng=rng)
        self.looks = [table_look(rng), object_look(rng)]
        self.lamp = lamp(rng)
        self.turn = float(rng.uniform(0, 2 * np.pi))
        yaw = rng.uniform(0, 2 * np.pi)
        table = np.array([0, 0, -0.5 * TABLE_SIZE[2], np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)])
        self.poses = np.stack([table, pose])


def _eyes(extrinsics: list[Floats], baseline: float | None) -> Floats:
    if baseline is None:
        return np.stack(extrinsics)
    return np.stack([eye for middle in extrinsics for eye in stereo_pair(middle, baseline)])


def _toward_lamp(rng: np.random.Generator) -> Floats:
    # One height for all scenes of a call; each scene turns under the lamp, so azimuths differ.
    elevation = np.radians(rng.uniform(40.0, 65.0))
    return np.array([np.cos(elevation), 0.0, np.sin(elevation)])


def _ticker(progress: Progress | None, pictures: int) -> Callable[[float], None] | None:
    if progress is None:
        return None
    return lambda share: progress(share * pictures, pictures, f"rendering {pictures} pictures")


def _stage(obj: ObjectModel, worlds: int, device: str) -> Stage:
    """Stage of the object on a table, kept for the next call with the same object."""
    key = (obj.digest, len(obj.faces), len(obj.vertices), worlds, device)
    if key in _stages:
        _stages.move_to_end(key)
        return _stages[key]
    _stages[key] = Stage([Box(TABLE_SIZE), Solid(obj.vertices, obj.faces, obj.corner_normals)], worlds, device)
    while len(_stages) > _KEPT_STAGES:
        _stages.popitem(last=False)
    return _stages[key]
