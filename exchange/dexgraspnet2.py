"""DexGraspNet 2.0's folder: scenes as in GraspNet-1Billion, and dexterous grasps for each.

Zhang et al., DexGraspNet 2.0, CoRL 2024. docs/how-to/exchange/dexgraspnet2.md describes files and graspness, the
distance-weighted number of grasps that aim at a point. Values follow src/preprocess/dex_graspness.py, and clouds follow
src/utils/pc.py, both of zcyqyq/DexTouch-sim2real at 7824d859a8da1d942bc38709a9d217dfb548db5d.

Their code uses thumb and middle finger of a LEAP hand, and the centre of its palm's box. This module uses any hand's
thumb, the mean of its other fingertips, and the palm's surface. Their code stops if a grasp sees no point. Here such a
grasp aims at the point nearest to the palm.

`service.readers.clouds.graspness` differs: it is the share of grasps whose hand touches a point."""

from __future__ import annotations

import shutil
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import scipy.io
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from graspd.exchange.imported import ImportedGrasps, add_postures, joints_by_name, parse_verdicts, scaled_object
from graspd.exchange.plan import ExportPart, ExportSummary, PictureReference, group_by_scene, plain_name
from graspd.service.model.base import error_text
from graspd.service.model.errors import InputError
from graspd.service.model.transforms import (
    IDENTITY_POSE,
    Floats,
    apply,
    compose,
    invert,
    pose_from_matrix,
    pose_to_matrix,
    quat_rotate,
)
from graspd.service.readers import DepthNoise, Pictures
from graspd.service.readers.clouds import CloudView
from graspd.worker.grasps import GraspSet, Posture
from graspd.worker.hands.jaws import fingertip_pad
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.surface import OVERSAMPLING, farthest_points
from graspd.worker.objects.distance import sample_faces
from graspd.worker.objects.model import ObjectModel
from graspd.worker.rendering.annotate import OBJECT
from graspd.worker.rendering.export import export_png

SAMPLES: Final = 1000  # number of surface points that represent an object
#: Half the opening of a grasp's view cone [rad], and its depth beyond the first point [m].
CONE: Final = np.pi / 6
BAND_M: Final = 0.02
#: Angle [rad] and distance beyond the first point [m] that each add 1 to the cost of a seen point.
ANGLE_HALF: Final = np.pi / 18
HEIGHT_HALF_M: Final = 0.015
FALL_PER_M: Final = 150.0  # powers of ten by which a grasp's weight falls per metre from its aim point [1/m]
#: Largest distance of a pixel from the point whose value it takes [m]. Their code documents 15 mm, but compares 0.015
#: with the squared distance of pytorch3d's `knn_points`.
REACH_M: Final = 0.015**0.5
OUTLIER_M: Final = 0.02  # largest distance of the cloud's points from the box around all objects [m]
_AT_ONCE: Final = 256  # number of grasps in a block of computation: about 6 MB per array


def surface_samples(obj: ObjectModel) -> Floats:
    """Sample evenly spread surface points (`SAMPLES`, 3) [m]; equal objects have equal points."""
    many = sample_faces(obj.vertices, obj.faces.astype(np.int64), OVERSAMPLING * SAMPLES)[0]
    return many[farthest_points(many, SAMPLES)]


@dataclass(frozen=True)
class SceneGraspness:
    """Graspness of the object in a scene, from all its grasps in this scene."""

    samples: Floats  # (S, 3) points of the object's surface, in its frame [m]
    pointed: NDArray[np.intp]  # (K,) index of the point that each grasp aims at
    values: Floats  # (S,) graspness of the points, between 0 and K

    @classmethod
    def from_grasps(cls, hand: HandModel, grasps: Posture, samples: Floats) -> SceneGraspness:
        """Compute the graspness from K grasps in the object's frame; without grasps all values are 0."""
        pointed = aim_points(*lines_of_sight(hand, grasps), samples)
        return cls(samples, pointed, sum_graspness(samples, pointed))

    def picture_graspness(
        self, depth: Floats, labels: NDArray[np.uint8], intrinsics: Floats, camera: Floats, object_pose: Floats
    ) -> NDArray[np.float32]:
        """Return the graspness (N, 1) of a picture's points, as the loader makes and orders them.
        It is 0 on neighbours. `depth` (H, W) [m] is 0 without a surface. `labels` (H, W) are 0 for background and 1 for
        the grasps' object; at least one is not 0. `intrinsics` are (3, 3) [px]. `camera` (4, 4) and `object_pose` (7,):
        table's frame."""
        cloud = back_project(depth, intrinsics)
        inside = workspace_mask(cloud, depth, labels, camera)
        found = np.zeros(np.count_nonzero(inside), np.float32)
        mine = labels[inside] == 1
        points = apply(invert(object_pose), cloud[inside][mine])
        # Without a sample within reach, the index is past the last sample.
        nearest = cKDTree(self.samples).query(points, distance_upper_bound=REACH_M)[1]
        found[mine] = np.append(self.values, 0)[nearest]
        return found[:, None]


def lines_of_sight(hand: HandModel, grasps: Posture) -> tuple[Floats, Floats]:
    """Return origins (K, 3) [m] and unit directions (K, 3) of the grasps' lines of sight.
    A line leads from the palm to the middle of thumb and fingers. The thumb is the fingertip farthest from the other
    fingertips of the open hand. With one fingertip, or fingers that meet in the palm, the line is the approach."""
    palm = apply(grasps.hand_pose, hand.palm.centre)
    line = quat_rotate(grasps.hand_pose[:, 3:], hand.palm.approach)
    if len(hand.fingertips) < 2:
        return palm, line
    open_ = _fingertips(hand, Posture(IDENTITY_POSE[None], hand.expand(hand.preshape)[None]))[0]
    thumb = int(cdist(open_, open_).sum(axis=1).argmax())
    tips = _fingertips(hand, grasps)
    middle = 0.5 * (tips[:, thumb] + np.delete(tips, thumb, axis=1).mean(axis=1))
    length = np.linalg.norm(middle - palm, axis=1, keepdims=True)
    return palm, np.where(length > 1e-6, (middle - palm) / np.maximum(length, 1e-6), line)


def _fingertips(hand: HandModel, grasps: Posture) -> Floats:
    """Return (K, F, 3) contact points of the fingertips [m]."""
    pads = np.array([fingertip_pad(hand, tip).centre for tip in hand.fingertips])
    return apply(body_poses(hand, grasps.hand_pose, grasps.joint_positions)[:, list(hand.fingertips)], pads)


def aim_points(palm: Floats, line: Floats, samples: Floats) -> NDArray[np.intp]:
    """Return indices (K,) of aim points in `samples` (S, 3), seen from `palm` along `line` (K, 3) [m]."""
    found = np.empty(len(palm), np.intp)
    for first in range(0, len(palm), _AT_ONCE):
        some = slice(first, first + _AT_ONCE)
        away = samples - palm[some, None]
        distance = np.linalg.norm(away, axis=2)
        height = np.einsum("ksi,ki->ks", away, line[some])
        angle = np.arccos(np.clip(height / np.maximum(distance, 1e-12), -1, 1))
        seen = (height > 0) & (angle < CONE)
        beyond = height - np.where(seen, height, np.inf).min(axis=1, keepdims=True)
        seen &= beyond < BAND_M
        cost = np.where(seen, angle / ANGLE_HALF + beyond / HEIGHT_HALF_M, np.inf)
        found[some] = np.where(seen.any(axis=1), cost.argmin(axis=1), distance.argmin(axis=1))
    return found


def sum_graspness(samples: Floats, pointed: NDArray[np.intp]) -> Floats:
    """Return (S,) graspness of points (S, 3) [m] from the aim points' indices (K,)."""
    count = np.bincount(pointed, minlength=len(samples))
    some = np.flatnonzero(count)
    # Sum per point, not per grasp: at most S x S numbers for any number of grasps.
    return np.asarray(10.0 ** (-FALL_PER_M * cdist(samples, samples[some])) @ count[some], float)


def back_project(depth: Floats, intrinsics: Floats) -> Floats:
    """Return the points (H, W, 3) of a picture in the camera's frame [m], bit for bit as in the loader."""
    u, v = np.meshgrid(np.arange(depth.shape[1]), np.arange(depth.shape[0]))
    x = (u - intrinsics[0, 2]) * depth / intrinsics[0, 0]
    y = (v - intrinsics[1, 2]) * depth / intrinsics[1, 1]
    return np.stack([x, y, depth], axis=-1)


def workspace_mask(cloud: Floats, depth: Floats, labels: NDArray[np.uint8], camera: Floats) -> NDArray[np.bool_]:
    """Return a mask (H, W) of the pixels whose points (H, W, 3) the loader keeps.
    They have a depth and are near the box around the labelled points. The box is in the table's frame. As in the
    loader, labelled pixels without depth extend it to the camera."""
    whole = np.concatenate([cloud.reshape(-1, 3), np.ones((depth.size, 1))], axis=1)
    there = np.einsum("ab,nb->na", camera, whole)[:, :3]
    objects = there[labels.reshape(-1) > 0]
    low, high = objects.min(axis=0) - OUTLIER_M, objects.max(axis=0) + OUTLIER_M
    inside = ((there > low) & (there < high)).all(axis=1)
    return np.asarray(inside.reshape(depth.shape) & (depth > 0))


Noise = DepthNoise | None
CAMERA: Final = "realsense"
VIEWS: Final = 256  # number of views of each scene; the loader samples among them
FACTOR: Final = 10000  # steps per metre in a depth picture: 16 bits reach 6.5 m
#: Numbers of scenes for training (`train_1`, `part`), and for held-out objects (`val`, `test`).
TRAIN: Final = (range(90), range(1000, 8500))
HELD_OUT: Final = (range(90, 100), range(100, 190))
#: Keys of a file of grasps that are no joints: those of the loader, and further ones of graspd.
_PLACE: Final = ("translation", "rotation", "point")
_OURS: Final = ("pregrasp_qpos", "squeeze_qpos", "success", "row")
#: Argument names of `numpy.savez_compressed`, which no array may have.
_NUMPYS: Final = ("file", "args", "kwds", "allow_pickle")
#: Largest size of a `meta` file [bytes]; real ones have 2 kB. Compression is at most 1,000-fold.
_LARGEST_META: Final = 64 * 2**10
#: Largest unpacked size of an `.npz` file [bytes]; the grasps of one object are far smaller.
LARGEST: Final = 2**30
_MEMBERS: Final = 1024  # largest number of arrays in an `.npz` file


def write(
    lots: Sequence[ExportPart], pictures: Pictures, folder: Path, out: frozenset[str], noise: Noise = None
) -> ExportSummary:
    """Write each scene with its pictures and grasps.
    Raises InputError: the folder has data already, there is no scene, or there are too many for the format."""
    top = folder / "data"
    if top.exists():
        raise InputError(f"{top} exists already; give another folder as --output")
    known = {lot.id: lot for lot in lots}
    seen = group_by_scene(pictures)
    scenes = [some for some in seen if some[0].base in known and len(some[0].rows)]
    if not scenes:
        if any(some[0].base in known for some in seen):
            raise InputError("no grasp is valid and clear in the pictured scenes; plan grasps in scenes: synth --scene")
        raise InputError("no picture shows a scene with grasps; render views into the grasps' folder: graspd render")
    done = ExportSummary({"grasps": 0, "scenes": len(scenes), "views": 0, "files": len(scenes)})
    held_out = sum(known[some[0].base].name in out for some in scenes)
    numbers = {False: _scene_numbers(len(scenes) - held_out, TRAIN), True: _scene_numbers(held_out, HELD_OUT)}
    samples: dict[str, Floats] = {}
    for some in scenes:
        lot = known[some[0].base]
        name = f"scene_{next(numbers[lot.name in out]):04}"
        if lot.id not in samples:
            samples[lot.id] = surface_samples(lot.obj)
        graspness = SceneGraspness.from_grasps(lot.hand, lot.grasps.grasp.take(some[0].rows), samples[lot.id])
        _write_scene(some[:VIEWS], pictures, top, name, noise, graspness)
        _write_grasps(some[0], lot, top / "dex_grasps_new" / name / plain_name(lot.hand.name), graspness)
        done.counts["grasps"] += len(some[0].rows)
        done.counts["views"] += min(len(some), VIEWS)
    if not out:
        done.notes.append("only one object: all scenes have numbers for training, none for a test")
    return done


def _scene_numbers(count: int, ranges: Sequence[range]) -> Iterator[int]:
    numbers = [number for some in ranges for number in some]
    if count > len(numbers):
        what = "held-out objects" if ranges is HELD_OUT else "objects to train on"
        raise InputError(f"there are {count} scenes of {what}, but DexGraspNet 2.0 has numbers for {len(numbers)}")
    return iter(numbers)


def _write_scene(
    some: list[PictureReference], pictures: Pictures, top: Path, name: str, noise: Noise, graspness: SceneGraspness
) -> None:
    path, values = top / "scenes" / name / CAMERA, top / "dex_graspness_new" / name / CAMERA
    kinds = ((path / "depth_gt", "png"), (path / "label_gt", "png"), (path / "meta", "mat"), (values, "npy"))
    for folder, _ in kinds:
        folder.mkdir(parents=True)
    first = pose_to_matrix(_camera(some[0]))
    poses = [pose_to_matrix(compose(pose_from_matrix(some[0].extrinsics), _camera(look))) for look in some]
    np.save(path / "cam0_wrt_table.npy", first)
    np.save(path / "camera_poses.npy", np.array([poses[view % len(some)] for view in range(VIEWS)]))
    for view, look in enumerate(some):
        sample = pictures[look.index]
        steps = CloudView(sample, noise, np.random.default_rng(look.index)).seen * FACTOR
        steps = np.where(steps < np.iinfo(np.uint16).max + 0.5, np.rint(steps), 0)
        export_png(path / "depth_gt" / f"{view:04}.png", steps.astype(np.uint16))
        labels = np.maximum(np.asarray(sample["image/segmentation"], int) - (OBJECT - 1), 0).astype(np.uint8)
        export_png(path / "label_gt" / f"{view:04}.png", labels)
        # Pixel (u, v) has its centre at u, v in the loader, but at u + 0.5, v + 0.5 in graspd.
        intrinsics = np.asarray(sample["camera/intrinsics"], float) - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
        pose = np.asarray(sample["object/pose"])
        meta = {
            "intrinsic_matrix": intrinsics,
            "factor_depth": np.array([[FACTOR]]),
            "cls_indexes": np.array([[1]]),
            "poses": pose_to_matrix(pose)[:3, :, None],
        }
        scipy.io.savemat(path / "meta" / f"{view:04}.mat", meta)
        if labels.any():  # the loader skips empty views, which have no workspace
            found = graspness.picture_graspness(steps / FACTOR, labels, intrinsics, first @ poses[view], pose)
            np.save(values / f"{view:04}.npy", found)
    # The loader samples among 256 views, so further views repeat the same files.
    for view in range(len(some), VIEWS):
        for folder, suffix in kinds:
            _link_or_copy(folder / f"{view % len(some):04}.{suffix}", folder / f"{view:04}.{suffix}")


def _link_or_copy(file: Path, copy: Path) -> None:
    if not file.exists():
        return
    try:
        copy.hardlink_to(file)
    except OSError:
        shutil.copyfile(file, copy)


def _camera(look: PictureReference) -> Floats:
    """Return the pose (7,) of the camera in the table's frame."""
    return invert(pose_from_matrix(look.extrinsics))


def _write_grasps(look: PictureReference, lot: ExportPart, folder: Path, graspness: SceneGraspness) -> None:
    names = lot.hand.joint_names
    if taken := set(names) & {*_PLACE, *_OURS, *_NUMPYS}:
        raise InputError(f"{lot.hand.name} has a joint {sorted(taken)[0]!r}, which is a key of DexGraspNet 2.0's files")
    in_camera = compose(pose_from_matrix(look.extrinsics), look.object_pose)
    some = {name: getattr(lot.grasps, name).take(look.rows) for name in ("pregrasp", "grasp", "squeeze")}
    placed = {name: compose(in_camera, part.hand_pose) for name, part in some.items()}
    matrices = pose_to_matrix(placed["grasp"])
    point = apply(in_camera, graspness.samples[graspness.pointed])
    arrays: dict[str, Any] = {"translation": matrices[:, :3, 3], "rotation": matrices[:, :3, :3], "point": point}
    arrays |= {name: some["grasp"].joint_positions[:, k] for k, name in enumerate(names)}
    # The loader ignores these arrays; the importer needs them.
    for name in ("pregrasp", "squeeze"):
        arrays[f"{name}_qpos"] = np.concatenate([placed[name], some[name].joint_positions], axis=1)
    arrays |= {"success": lot.verdict[look.rows], "row": look.rows}
    folder.mkdir(parents=True)
    np.savez_compressed(folder / f"{lot.name}.npz", **arrays)


def read(path: Path, *, hand: str, obj: str, number: int = 0) -> list[ImportedGrasps]:
    """Read grasps of `data/dex_grasps_new/SCENE/HAND/OBJECT.npz`, in the object's frame.
    `number` is the index, from 0, of the object in the scene, whose `meta` has the object's pose."""
    found = load_npz(path)
    try:
        count = len(found["translation"])
        matrices = np.tile(np.eye(4), (count, 1, 1))
        matrices[:, :3, :3], matrices[:, :3, 3] = found["rotation"], found["translation"]
    except (KeyError, ValueError, TypeError) as error:
        raise InputError(f"{path} is no file of grasps of DexGraspNet 2.0: {error}") from None
    if not np.isfinite(matrices).all():
        raise InputError(f"{path} has grasps whose pose is not finite")
    away = invert(_object_pose(path, number))
    model, thing = hand_from_path(hand), scaled_object(obj)
    names = [name for name in found if name not in (*_PLACE, *_OURS)]
    try:
        values = np.stack([np.asarray(found[name], float).reshape(count) for name in names], axis=1)
    except ValueError as error:
        raise InputError(f"{path} needs one value of each joint for each of {count} grasps: {error}") from None
    grasp = Posture(compose(away, pose_from_matrix(matrices)), joints_by_name(model, names, values, what=str(path)))
    grasps = _add_postures(path, model, thing, found, grasp, away)
    success = found.get("success")
    published = None if success is None or np.size(success) != count else parse_verdicts(success)
    return [ImportedGrasps(model, thing, grasps, path.stem, published=published)]


def _add_postures(
    path: Path, hand: HandModel, obj: ObjectModel, found: dict[str, NDArray[Any]], grasp: Posture, away: Floats
) -> GraspSet:
    """Return grasps with pregrasp and squeeze from a file of graspd, or as graspd computes them."""
    if not {"pregrasp_qpos", "squeeze_qpos"} <= set(found):
        return add_postures(hand, obj, grasp)
    parts = []
    for name in ("pregrasp_qpos", "squeeze_qpos"):
        qpos = np.asarray(found[name], float)
        if qpos.shape != (len(grasp), 7 + len(hand.joint_names)):
            raise InputError(f"{path}: {name} has the shape {qpos.shape}")
        parts.append(Posture(compose(away, qpos[:, :7]), qpos[:, 7:]))
    return GraspSet(grasp, parts[0], parts[1], np.full(len(grasp), np.nan))


def _object_pose(path: Path, number: int) -> Floats:
    """Return the object's pose (7,) in the camera frame of view 0, the frame of the grasps."""
    try:
        scene, data = path.resolve().parents[1].name, path.resolve().parents[3]
    except IndexError:
        raise InputError(f"{path} is in no folder dex_grasps_new/SCENE/HAND") from None
    file = data / "scenes" / scene / CAMERA / "meta" / "0000.mat"
    if not file.is_file():
        raise InputError(f"{path} needs its scene: {file} does not exist")
    if file.stat().st_size > _LARGEST_META:
        raise InputError(f"{file} is larger than {_LARGEST_META >> 10} KiB, too large for the description of a view")
    try:
        poses = np.asarray(scipy.io.loadmat(file)["poses"], float)
        pose = np.concatenate([poses[:3, :, number], [[0, 0, 0, 1]]])
    except Exception as error:
        # SciPy raises arbitrary exceptions; all of them mean an invalid file.
        raise InputError(f"{file} has no pose of object {number}: {error}") from None
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise InputError(f"{file} has no pose of object {number}")
    return pose_from_matrix(pose)


def load_npz(path: Path) -> dict[str, NDArray[Any]]:
    """Load a `.npz` file's arrays; refuse pickled objects, and files that unpack to more than `LARGEST`."""
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
        # A member is never unpacked beyond its `file_size`.
        if len(members) > _MEMBERS or sum(member.file_size for member in members) > LARGEST:
            raise InputError(f"{path} unpacks to more than {LARGEST >> 20} MiB or to more than {_MEMBERS} arrays")
        with np.load(path, allow_pickle=False) as found:
            return {name: found[name] for name in found.files}
    except (OSError, ValueError, EOFError, KeyError, MemoryError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(f"{path} is no .npz file that can be read safely: {error_text(error)}") from None
