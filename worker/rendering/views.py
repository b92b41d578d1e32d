"""Views of scenes: pictures of an object on a table, with all labels for training networks."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.errors import InputError
from graspd.service.model.pinhole import pixel_rays
from graspd.service.model.transforms import Floats, apply
from graspd.worker.execution_context import DEFAULT_CONTEXT, ExecutionContext
from graspd.worker.objects.mesh_geometry import to_centred_frame
from graspd.worker.objects.model import ObjectModel
from graspd.worker.rendering.annotate import box_corners, occlusion_ratio, tight_boxes
from graspd.worker.rendering.cameras import BASELINE_M, SAMPLED, Cameras, GivenCameras
from graspd.worker.rendering.hands import DrawnHand
from graspd.worker.rendering.scene_setup import CameraPlan, SceneSetup
from graspd.worker.rendering.scenery import TABLE, Pictures, Supports
from graspd.worker.scenes.neighbours import Neighbours

SAMPLES: Final = 12  # passes per picture; the lamp lights half of them, the sky the other half

Arrays = dict[str, NDArray[np.generic]]


@dataclass(frozen=True)
class Extras:
    """Additions to a render: channels, given cameras, neighbours, a hand, supports."""

    channels: Sequence[str] = ()  # of `service.model.domain.EXTRA_CHANNELS`
    cameras: GivenCameras = SAMPLED  # given intrinsics and poses instead of sampled ones
    neighbours: Neighbours | None = None
    drawn: DrawnHand | None = None  # hands of `image/rgb_hand`; they are in no other picture
    supports: Supports = TABLE  # supports of the object; all are labelled as the table


NO_EXTRAS: Final = Extras()


def render(
    obj: ObjectModel,
    object_pose: Floats,
    *,
    views: int,
    stereo: bool,
    width: int,
    height: int,
    seed: int,
    run: ExecutionContext = DEFAULT_CONTEXT,
    baseline_m: float = BASELINE_M,
    samples: int = SAMPLES,
    extras: Extras = NO_EXTRAS,
) -> Arrays:
    """Render every scene from sampled or given cameras.
    Raises InputError: a count or size is out of range. TaskCancelled: `run.cancelled()` returned True.

    Args:
        object_pose: (S, 7) rest poses in the table frame.
        views: camera placements per scene, unless cameras are given.
        stereo: whether a placement has rectified left and right pictures, `baseline_m` apart.
        width, height: picture size [px].
        seed: seed of cameras, materials and lights, and thus of all pixels. Scene s depends on (seed, s) alone.
        run: receives the number of finished pictures; polled before each launch. Pixels do not depend on its threads.
        samples: rays per pixel.

    Returns:
        Columns of a views shard with V = S * views * (2 if stereo else 1) pictures, sorted by scene, placement and eye.
        Labels come from the ray through the pixel's centre; in `image/depth` the table is a surface like any other."""
    poses = np.asarray(object_pose, float).reshape(-1, 7)
    plan = CameraPlan(views, width, height, baseline_m if stereo else None, extras.cameras)
    if plan.placements < 1 or width < 1 or height < 1 or samples < 2 or len(poses) == 0:
        raise InputError(
            f"rendering needs at least one scene, view and pixel and two samples; "
            f"got {len(poses)} scenes, {views} views, {width} x {height} px, {samples} samples"
        )
    beside = (extras.neighbours or Neighbours((), np.zeros((len(poses), 0, 7)))).centred
    obj, poses = obj.centred, to_centred_frame(poses, obj.centre)
    placed = np.concatenate([poses[:, None], beside.poses], axis=1)
    setting = SceneSetup([obj, *beside.objects], placed, plan, seed=seed, samples=samples, supports=extras.supports)
    pictures = setting.render(run, normals="normals" in extras.channels)
    result = annotate(setting, pictures, obj, extras.channels)
    if "occlusion" in extras.channels:
        alone = setting.render_object_alone(run.without_progress()).shape == 1
        result["box/occlusion_ratio"] = occlusion_ratio(np.asarray(result["image/segmentation"], np.uint8), alone)
    if extras.drawn is not None:
        seen = setting.render_with_hand(extras.drawn, run.without_progress())
        result["image/rgb_hand"] = seen.rgb
        result["camera/hand_grasp"] = extras.drawn.grasp[setting.shot.world].astype(np.int32)
    return result


def annotate(setting: SceneSetup, pictures: Pictures, obj: ObjectModel, channels: Sequence[str] = ()) -> Arrays:
    """Compute the datasets of a views shard that follow from cameras and pictures."""
    shot, plan = setting.shot, setting.plan
    cameras = Cameras(plan.width, plan.height, shot.intrinsics, shot.extrinsics)
    count, poses = len(shot.world), setting.object_pose[shot.world][:, None]
    segmentation = (pictures.shape + 1).astype(np.uint8)
    # Occluded vertices, and vertices outside the picture, also count.
    pixels, _ = cameras.project(apply(poses, obj.vertices))
    rotation, shift = shot.extrinsics[:, :3, :3], shot.extrinsics[:, None, :3, 3]
    corners = np.einsum("vij,vpj->vpi", rotation, apply(poses, box_corners(obj.vertices))) + shift
    result: Arrays = {
        "camera/intrinsics": np.repeat(shot.intrinsics[None], count, axis=0),
        "camera/extrinsics": shot.extrinsics,
        "camera/scene_index": shot.world,
        "camera/eye": np.tile(np.array([0] if plan.eyes == 1 else [1, 2], np.uint8), count // plan.eyes),
        "camera/stereo_baseline_m": np.full(count, plan.baseline_m or 0.0),
        "image/rgb": pictures.rgb,
        "image/depth": pictures.depth,
        "image/segmentation": segmentation,
        "box/bounding_box_2d_tight": tight_boxes(segmentation),
        "box/bounding_box_2d_loose": np.concatenate([pixels.min(axis=1), pixels.max(axis=1)], axis=1, dtype=np.float32),
        "box/bounding_box_3d": corners.astype(np.float32),
    }
    if "distance" in channels:
        stretch = np.linalg.norm(pixel_rays(shot.intrinsics, plan.width, plan.height), axis=-1)
        result["image/distance"] = (pictures.depth * stretch).astype(np.float32)
    if pictures.normal is not None:
        result["image/normals"] = pictures.normal.astype(np.float16)
    return result
