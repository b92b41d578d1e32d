"""Labelled point clouds of pictures, from true depth or the depth of a simulated camera."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from graspd.service.model import transforms
from graspd.service.model.errors import InputError
from graspd.service.model.pinhole import back_project, fitted_normals, surface_normals
from graspd.service.model.transforms import Floats
from graspd.service.readers.depth_noise import DepthNoise, incidence_angle, parse_depth_noise
from graspd.service.readers.pictures import PictureAddress, Pictures, Scenes
from graspd.service.store.shards import Shard

Array = NDArray[Any]
Ints = NDArray[np.intp]
#: Function from a base shard and K of its rows to points (K, H, 3) on the hand's surface in the object's frame [m].
HandSurface = Callable[[Shard, Ints], Floats]
Frame = Literal["camera", "table", "object"]
FRAMES: Final[tuple[Frame, ...]] = ("camera", "table", "object")
POSTURES: Final = ("pregrasp", "grasp", "squeeze")
#: Prefixes of the keys with one row per grasp.
OF_GRASPS: Final = ("pregrasp/", "grasp/", "squeeze/", "quality/")
#: Largest distance between hand and point at a contact [m]: the middle contact threshold of shards.
TOUCH_M: Final = 0.005


class Clouds(Sequence[dict[str, Any]]):
    """Point clouds of single views, or fused from all views of a scene. `clouds[i]` is a dictionary:

        cloud/points (P, 3) [m]; cloud/normals (P, 3), unit, toward the camera that saw the point
        cloud/object (P,) 1 where the pixel shows the object; cloud/pixel (P, 3): view, row, column
        cloud/seen: number of visible points. If fewer than P, some points repeat; if 0, all values are zero
        cloud/graspness (P,), optional: share of the scene's K grasps whose hand touches the point
        camera/intrinsics (3, 3) K [px], camera/extrinsics (4, 4) E, table to camera; for fused views (V, ...)
        table/plane (4,) n and d of n.x = d, the table's top; table/height [m] of the top along n in the table's frame
        object/pose (7,) of the object's frame
        grasp/hand_pose (K, 7), likewise for other `postures`; grasp/joint_positions (K, J)
        grasp/hand_pose_camera (not for fused views), grasp/hand_pose_table, grasp/hand_pose_object in these frames
        grasp/base_row (K,), base_id, and the columns of `grasp_quality` of the pictures

    Points, plane and poses are in `frame`. `pictures` selects the grasps, by default valid grasps clear in the scene.
    """

    def __init__(
        self,
        pictures: Pictures,
        points: int = 1024,
        *,
        noise: str | DepthNoise | None = None,
        frame: Frame | None = None,
        fuse: bool = False,
        scene: bool = False,
        voxel_m: float = 0.0,
        postures: Sequence[str] = ("grasp",),
        hand_surface: HandSurface | None = None,
        touch_m: float = TOUCH_M,
        seed: int = 0,
    ) -> None:
        """Args:
            pictures: the pictures and the selection of grasps in their scenes.
            points: P, number of points of a cloud.
            noise: a depth camera by name (`depth_noise.NOISES`) or a `DepthNoise`; None: perfect depth.
            frame: camera, table or object; by default camera, for fused views table.
            fuse: return one cloud for all views of a scene.
            scene: include table and neighbours; by default only the object.
            voxel_m: keep one point per cube of this edge [m]; 0: all.
            postures: postures to return for each grasp, among pregrasp, grasp and squeeze.
            hand_surface: function that enables graspness, such as `graspd.readers.hand_surface`.
            touch_m: largest distance of a contact [m].
            seed: seed of the sampled points and the noise; equal seeds and epochs give equal clouds.

        Raises InputError for an unknown noise, frame or posture, or a number out of range.
        """
        chosen = frame or ("table" if fuse else "camera")
        if chosen not in FRAMES or (fuse and chosen == "camera"):
            raise InputError(f"clouds {'of several views ' * fuse}have no frame {chosen!r}; choose table or object")
        if unknown := set(postures) - set(POSTURES):
            raise InputError(f"there is no posture {sorted(unknown)[0]!r}; choose from {', '.join(POSTURES)}")
        if points < 1 or voxel_m < 0 or touch_m <= 0 or seed < 0:
            raise InputError("clouds need points >= 1, voxel_m >= 0, touch_m > 0 and seed >= 0")
        self.pictures, self.points, self.frame, self.epoch = pictures, points, chosen, 0
        self._noise, self._whole, self._voxel, self._seed = parse_depth_noise(noise), scene, voxel_m, seed
        self._postures, self._surface, self._touch = tuple(postures), hand_surface, touch_m
        self._fused = fuse
        self._places = _group_by_scene(pictures.places) if fuse else [[place] for place in pictures.places]

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        places = self._places[index]
        first, scenes = places[0], self.pictures.scenes_of(places[0].scene_shard)
        draw = np.random.default_rng([self._seed, self.epoch, *_seed_words(first)])
        views = [CloudView(self.pictures.columns_of(place, COLUMNS), self._noise, draw) for place in places]
        object_pose = scenes.object_pose(first.scene)
        into = self._frame_transform(views[0].extrinsics, object_pose)
        sample = self._sample_cloud(views, draw, into)
        if self._surface is not None:
            touched = self._graspness(views, sample["cloud/pixel"], scenes, first.scene)
            sample["cloud/graspness"] = np.where(sample["cloud/object"] == 1, touched, 0.0).astype(np.float32)
        for name in ("camera/intrinsics", "camera/extrinsics"):
            matrices = [view.columns[name] for view in views]
            sample[name] = np.stack(matrices) if self._fused else matrices[0]
        normal = transforms.quat_rotate(into[3:], np.array([0.0, 0.0, 1.0]))
        sample |= {"table/plane": np.append(normal, normal @ into[:3]), "table/height": 0.0}
        sample["object/pose"] = transforms.compose(into, object_pose)
        return sample | self._labels(scenes, first.scene, views[0].extrinsics, into) | first.names

    def _sample_cloud(self, views: Sequence[CloudView], draw: np.random.Generator, into: Floats) -> dict[str, Any]:
        found = [view.pixels(whole=self._whole) for view in views]
        pixel = np.concatenate([np.stack([np.full(len(row), v), row, col], 1) for v, (row, col) in enumerate(found)])
        if self._voxel:
            pixel = pixel[_voxel_sample(_gather(views, pixel, CloudView.points), self._voxel, draw)]
        seen = len(pixel)
        if seen >= self.points:
            pixel = pixel[draw.choice(seen, self.points, replace=False)]
        elif seen:
            pixel = np.concatenate([pixel, pixel[draw.integers(seen, size=self.points - seen)]])
        normals = transforms.quat_rotate(into[3:], _gather(views, pixel, CloudView.normals))
        cloud: dict[str, Any] = {
            "cloud/points": transforms.apply(into, _gather(views, pixel, CloudView.points)).astype(np.float32),
            "cloud/normals": normals.astype(np.float32),
            "cloud/object": _gather(views, pixel, CloudView.is_object).astype(np.uint8),
            "cloud/pixel": pixel.astype(np.int32),
        }
        if not seen:
            cloud = {name: np.zeros((self.points, *part.shape[1:]), part.dtype) for name, part in cloud.items()}
        return cloud | {"cloud/seen": seen}

    def _graspness(self, views: Sequence[CloudView], pixel: Ints, scenes: Scenes, scene: int) -> Floats:
        """Compute graspness (P,) at the true points of the pixels, because noise does not change contacts."""
        assert self._surface is not None
        points = _gather(views, pixel, CloudView.true_points)
        on_object = transforms.apply(transforms.invert(scenes.object_pose(scene)), points)
        rows = scenes.base_rows(scene)
        hands = self._surface(scenes.base, rows) if len(rows) else np.zeros((0, 1, 3))
        return graspness(on_object, hands, touch_m=self._touch)

    def _labels(self, scenes: Scenes, scene: int, extrinsics: Floats, into: Floats) -> dict[str, Any]:
        found = scenes.grasps(scene, extrinsics)
        rows, pose = scenes.base_rows(scene), scenes.object_pose(scene)
        labels = {name: value for name, value in found.items() if name not in ("grasp/hand_pose", "object/pose")}
        for posture in self._postures:
            own = np.asarray(scenes.base[f"{posture}/hand_pose"], float)[rows]
            in_table = transforms.compose(pose, own)
            labels[f"{posture}/hand_pose"] = transforms.compose(into, in_table)
            if not self._fused:
                camera = transforms.pose_from_matrix(extrinsics)
                labels[f"{posture}/hand_pose_camera"] = transforms.compose(camera, in_table)
            labels |= {f"{posture}/hand_pose_table": in_table, f"{posture}/hand_pose_object": own}
            labels[f"{posture}/joint_positions"] = np.asarray(scenes.base[f"{posture}/joint_positions"])[rows]
        return labels

    def _frame_transform(self, extrinsics: Floats, object_pose: Floats) -> Floats:
        """Return the transform (7,) from the table's frame to the sample's frame."""
        if self.frame == "camera":
            return transforms.pose_from_matrix(extrinsics)
        if self.frame == "object":
            return transforms.invert(object_pose)
        return transforms.IDENTITY_POSE


def _group_by_scene(places: Sequence[PictureAddress]) -> list[list[PictureAddress]]:
    found: dict[tuple[str, int], list[PictureAddress]] = defaultdict(list)
    for place in places:
        found[place.file.id, place.scene].append(place)
    return list(found.values())


def _gather(views: Sequence[CloudView], pixel: Ints, what: Callable[[CloudView, Ints, Ints], Array]) -> Array:
    parts = [what(view, *pixel[pixel[:, 0] == number, 1:].T) for number, view in enumerate(views)]
    found = np.empty((len(pixel), *parts[0].shape[1:]), parts[0].dtype)
    for number, part in enumerate(parts):
        found[pixel[:, 0] == number] = part
    return found


def _voxel_sample(points: Floats, edge: float, draw: np.random.Generator) -> Ints:
    order = draw.permutation(len(points))
    cubes = np.floor(points[order] / edge).astype(np.int64)
    return order[np.unique(cubes, axis=0, return_index=True)[1]]


def _seed_words(place: PictureAddress) -> tuple[int, int]:
    """Return two seed words of a picture from hand, object, batch and row, independent of its file."""
    name = f"{place.file.hand}/{place.file.object}/{place.file.batch}"
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:8]), place.row


def graspness(points: NDArray[Any], hands: NDArray[Any], *, touch_m: float = TOUCH_M) -> Floats:
    """Compute the share of the grasps whose hand touches each point.

    Wang et al. 2021 (Graspness Discovery in Clutters, eq. 1) count sampled poses of a parallel gripper around a point
    that hold and are clear. Here graspness counts the valid grasps of a scene that touch the point, because grasps of a
    multi-finger hand touch several places and are optimised.

    Args:
        points: (P, 3) in the object's frame [m].
        hands: (K, H, 3) points on the surface of the hand in each grasp, in the same frame [m].
        touch_m: largest distance of a contact [m]; more than half the spacing of the hand's points.

    Returns:
        (P,) values between 0 and 1; 0 if there are no grasps. Raises InputError without SciPy.
    """
    try:
        from scipy.spatial import cKDTree
    except ModuleNotFoundError:
        raise InputError("graspness needs SciPy; install it: pip install 'graspd[worker]'") from None

    found = np.zeros(len(points))
    if len(hands) == 0 or len(points) == 0:
        return found
    tree = cKDTree(points)
    for hand in hands:
        near = hand[(hand >= points.min(axis=0) - touch_m).all(1) & (hand <= points.max(axis=0) + touch_m).all(1)]
        if len(near):
            touched = tree.query_ball_point(near, touch_m)
            found[np.unique(np.concatenate(touched).astype(np.intp))] += 1
    return found / len(hands)


COLUMNS: Final = ("image/depth", "image/segmentation", "camera/intrinsics", "camera/extrinsics")
_OBJECT: Final = 2
#: Planes are fitted to noisy points in windows of 7 x 7 pixels, within this number of standard deviations of depth.
_RADIUS: Final = 3
_DEVIATIONS: Final = 4.0
#: Largest ratio of depth to lateral distance on the surface in a window.
_SLOPE: Final = 3.0


class CloudView:
    """Columns `COLUMNS` of one picture, and its depth as a camera measures it; `draw` generates the noise."""

    def __init__(self, columns: Mapping[str, Array], noise: DepthNoise | None, draw: np.random.Generator) -> None:
        self.columns, self._noise = columns, noise
        self.extrinsics = np.asarray(columns["camera/extrinsics"], float)  # (4, 4), table to camera.
        self._back = transforms.invert(transforms.pose_from_matrix(self.extrinsics))
        self._k = np.asarray(columns["camera/intrinsics"], float)
        #: Measured depth (H, W) [m]; not finite: no measurement.
        self.seen = depth = np.asarray(columns["image/depth"], float)
        if noise is not None:
            self._angle = incidence_angle(depth, self._k)
            self.seen = noise.apply(depth, self._k, draw, angle=self._angle)

    def pixels(self, *, whole: bool) -> tuple[Ints, Ints]:
        labels = self.columns["image/segmentation"]
        wanted = np.isfinite(self.seen) & ((labels > 0) if whole else (labels == _OBJECT))
        if self._noise is None:  # A pixel without neighbours has no normal.
            wanted &= np.isfinite(self._normals[..., 0])
        row, column = np.nonzero(wanted & np.isfinite(self._true_positions[..., 2]))
        return row, column

    def points(self, row: Ints, column: Ints) -> Floats:
        return transforms.apply(self._back, self._points[row, column])

    def true_points(self, row: Ints, column: Ints) -> Floats:
        return transforms.apply(self._back, self._true_positions[row, column])

    def normals(self, row: Ints, column: Ints) -> Floats:
        """Return unit normals (P, 3) of pixels, toward the camera, in the frame of the table."""
        if self._noise is None:
            return transforms.quat_rotate(self._back[3:], self._normals[row, column])
        z = self._points[row, column, 2]
        gap = _SLOPE * _RADIUS * z / self._k[0, 0] + _DEVIATIONS * self._noise.sigma(z, self._angle[row, column])
        fitted = fitted_normals(self._points, row, column, radius=_RADIUS, gap_m=gap)
        return transforms.quat_rotate(self._back[3:], fitted)

    def is_object(self, row: Ints, column: Ints) -> NDArray[np.bool_]:
        return np.asarray(self.columns["image/segmentation"][row, column] == _OBJECT)

    @cached_property
    def _true_positions(self) -> Floats:
        return back_project(self._k, self.columns["image/depth"])

    @cached_property
    def _points(self) -> Floats:
        return self._true_positions if self._noise is None else back_project(self._k, self.seen)

    @cached_property
    def _normals(self) -> Floats:
        return surface_normals(self._true_positions)
