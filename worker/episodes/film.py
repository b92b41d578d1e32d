"""Films of episodes by a scene camera, a wrist camera and a moving camera.

Lights, materials and cameras are random within the ranges below and of `rendering.scene_setup.draw_*`."""

import io
import json
import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import warp as wp
from numpy.random import Generator
from numpy.typing import NDArray

from graspd.service.model.errors import InputError
from graspd.service.model.scene_spec import Box as BoxSupport
from graspd.service.model.scene_spec import HalfSpace, scene_supports
from graspd.service.model.transforms import (
    IDENTITY_POSE,
    Floats,
    apply,
    compose,
    invert,
    pose_from_matrix,
    quat_from_axis_angle,
    quat_rotate,
)
from graspd.service.readers.trajectories import scene_spec_of
from graspd.service.store.columns import Attribute
from graspd.service.store.shards import Shard
from graspd.worker.engines import backend
from graspd.worker.episodes.episode import Episode, Robot
from graspd.worker.episodes.execution import Executions
from graspd.worker.execution_context import DEFAULT_CONTEXT, ExecutionContext
from graspd.worker.hands.primitives import hull
from graspd.worker.objects.mesh_geometry import corner_normals, to_centred_frame
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.topology import join_meshes
from graspd.worker.rendering.annotate import box_corners
from graspd.worker.rendering.cameras import direction_of, distance_to_fill, intrinsics, look_at
from graspd.worker.rendering.hands import drawn_bodies, hand_parts
from graspd.worker.rendering.kernels import exposure, raster
from graspd.worker.rendering.kernels.shading import Light, Material
from graspd.worker.rendering.scene_setup import draw_lamp, draw_object_look, draw_table_look
from graspd.worker.rendering.scenery import TABLE, TABLE_SIZE, Solid, Supports, slab_poses
from graspd.worker.rendering.tracer import light_passes, struct_array

#: Labels of segmentations; neighbour m has label 5 + m.
BACKDROP, SUPPORT, OBJECT, HAND, ARM = range(5)
#: Vertical fields of view [rad].
VIEWS: Final = {"scene": np.radians(42.0), "wrist": np.radians(66.0), "moving": np.radians(42.0)}
#: Scene camera: elevation [rad], share of the view that the motion fills, largest offset of its aim on each axis [m].
ELEVATION: Final = (np.radians(20.0), np.radians(50.0))
FILL: Final = (0.6, 0.9)
AIM_M: Final = 0.02
#: Largest offset of the wrist camera from its place, and of the point at which it looks, on each axis [m].
MOUNT_M: Final = 0.004
#: Elevation of the lamp [rad]; its azimuth is uniform.
LAMP: Final = (np.radians(40.0), np.radians(65.0))
#: Rate at which the moving camera turns about the motion; half-way it is at the scene camera [rad/s].
ORBIT_RAD_S: Final = np.radians(12.0)
#: Table, large enough for an arm [m].
SLAB: Final = (2.4, 1.8, TABLE_SIZE[2])
_DRAWS: Final = 8  # draws of a scene camera; the one that sees most of the object when it sees least is chosen
_MOMENTS: Final = 8  # frames at which draws are compared
_GLANCE: Final = (48, 64)  # height and width of pictures for comparison [px]
_MARGIN_M: Final = 0.04  # room around the motion in the scene camera's view
_AHEAD_M: Final = 0.07  # the wrist camera looks at a point before the palm
#: Candidate places of the wrist camera: number of sides, distances beside the palm's edge and behind its surface [m].
_SIDES: Final = 12
_BESIDE_M: Final = (0.03, 0.06)
_BEHIND_M: Final = (-0.02, 0.02, 0.06)
_MAP: Final = 400  # edge of a shadow map [samples]
_FAR_M: Final = 5.0  # distance of lights, beyond all solids [m]
_SHADOW_M: Final = 0.15  # shadow maps extend so far beyond the motion [m]
_LIGHT: Final[Any] = Light
_VIEW: Final[Any] = raster.View
_AWAY: Final = np.array([0, 0, -50.0, 1, 0, 0, 0])


@dataclass(frozen=True)
class FilmOptions:
    """Options of films."""

    cameras: tuple[str, ...] = ("scene", "wrist")  # of `VIEWS`
    width: int = 320
    height: int = 240
    fps: float = 15.0
    lights: int = 4  # number of directions of light, each with a shadow map
    depth: bool = False
    segmentation: bool = False


def film_options(cameras: str, size: str = "320x240", channels: str = "", fps: float = 15.0) -> FilmOptions:
    """Parse lists separated by commas. Raises InputError: a camera, a size or a channel is unknown."""
    names, kinds = tuple(filter(None, cameras.split(","))), tuple(filter(None, channels.split(",")))
    if unknown := [*(set(names) - set(VIEWS)), *(set(kinds) - {"depth", "segmentation"})]:
        raise InputError(f"films have no {unknown[0]!r}; cameras: {', '.join(VIEWS)}; channels: depth, segmentation")
    found = re.fullmatch(r"(\d{2,4})x(\d{2,4})", size)
    if found is None or int(found[1]) % 2 or int(found[2]) % 2:
        raise InputError(f"the size of a film is WIDTHxHEIGHT, two even numbers up to 9998, not {size!r}")
    if not float(fps).is_integer():
        raise InputError(f"a film has a whole number of frames per second, not {fps:g}")
    return FilmOptions(
        names, int(found[1]), int(found[2]), fps, depth="depth" in kinds, segmentation="segmentation" in kinds
    )


@dataclass(frozen=True)
class Film:
    """T pictures of an episode by one camera."""

    rgb: NDArray[np.uint8]  # (T, H, W, 3) sRGB
    depth: NDArray[np.uint16] | None  # (T, H, W) along the optical axis [mm]; 0 without a surface
    segmentation: NDArray[np.uint8] | None  # (T, H, W) `SUPPORT`, `OBJECT`, ...
    intrinsics: Floats  # (3, 3) [px]
    pose: Floats  # (T, 7) camera in the scene: x right, y down, z forward


class EpisodeRenderer:
    """Renderer of episodes of one robot with one object. Not thread-safe."""

    def __init__(
        self,
        robot: Robot,
        obj: ObjectModel,
        *,
        supports: Supports = TABLE,
        neighbours: Sequence[ObjectModel] = (),
        options: FilmOptions = FilmOptions(),
        device: str = "cpu",
    ) -> None:
        backend.start_warp()
        self._robot, self.options, self._device = robot, options, device
        self._objects, self._supports = (obj, *neighbours), supports
        carrier = IDENTITY_POSE if robot.arm is None else 0.5 * (robot.arm.model.lower + robot.arm.model.upper)
        neutral = np.concatenate([carrier, robot.hand.preshape])
        parts = [hand_parts(model) for model, _ in robot.poses(neutral)]
        self._looks = [part.look for some in parts for part in some]
        sizes = [s.size if isinstance(s, BoxSupport) else SLAB for s in supports]
        boxes = (hull(box_corners(np.outer([-0.5, 0.5], size))) for size in sizes)
        solids = [Solid(corners, faces.astype(np.int32), corner_normals(corners, faces)) for corners, faces in boxes]
        solids += [Solid(o.centred.vertices, o.faces, o.corner_normals) for o in self._objects]
        solids += [part.solid for some in parts for part in some]
        self._load(solids)
        # A half-space casts no shadow on what is above it.
        self._casters = len(supports) if all(isinstance(s, HalfSpace) for s in supports) else 0
        labels = [OBJECT, *(5 + m for m in range(len(neighbours)))]
        labels += [label for label, some in zip((HAND, ARM), parts, strict=False) for _ in some]
        # The last label is that of part -1.
        self._labels = np.array([*[SUPPORT] * len(supports), *labels, BACKDROP], np.uint8)
        self._place(self._poses(neutral[None], _AWAY[None], np.tile(_AWAY, (1, len(neighbours), 1)), 0.0)[0])
        self._mount = self._find_mount(self._robot.poses(neutral)[0][1][0, 0])

    def film(self, episode: Episode, seed: Sequence[int], run: ExecutionContext = DEFAULT_CONTEXT) -> dict[str, Film]:
        """Return films of all cameras.
        The seed decides lights, materials and cameras. Raises TaskCancelled: `run.cancelled()` returned True."""
        rng, size = np.random.default_rng(seed), (self.options.height, self.options.width)
        looks = [draw_table_look(rng) for _ in self._supports] + [draw_object_look(rng) for _ in self._objects]
        self._scene.material = struct_array([*looks, *self._looks], Material, self._device)
        poses = self._poses(episode.state, episode.object_pose, episode.neighbour_pose, rng.uniform(0, 2 * np.pi))
        sphere = self._motion(episode, poses)
        lights = self._lights(*sphere, rng)
        cameras = self._cameras(episode, poses, *sphere, rng)
        places = np.stack(list(cameras.values()), axis=1)
        angles = [VIEWS[name] for name in cameras]
        keys, shadows = self._keys(len(cameras), 2 * size[0], 2 * size[1]), self._keys(self.options.lights, _MAP, _MAP)
        labelled = self._keys(len(cameras), *size)
        rgb, still = (wp.zeros((len(cameras), *size, 3), dtype=wp.uint8, device=self._device) for _ in range(2))
        empty = poses[0].copy()
        empty[len(self._supports) :] = _AWAY
        taken, seen = [], []
        # The first picture has no moving solids: it is the background of the scene camera.
        for t, pose in enumerate([empty, *poses]):
            run.check("the filming")
            self._place(pose)
            views = self._views(places[max(t - 1, 0)], angles, keys, [t > 0 and name == "scene" for name in cameras])
            self._cover(views, keys)
            self._cover(lights[-1], shadows, self._casters)
            inputs = [self._scene, views, keys, *lights, shadows, len(self._supports), still]
            wp.launch(raster.shade, rgb.shape[:3], inputs, [rgb], device=self._device)
            if t == 0:
                wp.copy(still, rgb)
                continue
            taken.append(rgb.numpy().copy())
            if self.options.depth or self.options.segmentation:
                self._cover(self._views(places[t - 1], angles, labelled), labelled)
                seen.append(self._read(labelled))
        films = {}
        for k, (name, pose) in enumerate(cameras.items()):
            depth = segmentation = None
            if self.options.depth:
                mm = np.rint(1000 * np.stack([depths[k] for _, depths in seen]))
                depth = np.minimum(mm, 2**16 - 1).astype(np.uint16)
            if self.options.segmentation:
                segmentation = self._labels[np.stack([parts[k] for parts, _ in seen])]
            matrix = intrinsics(size[1], size[0], VIEWS[name])
            films[name] = Film(np.stack([one[k] for one in taken]), depth, segmentation, matrix, pose)
        return films

    def _load(self, solids: Sequence[Solid]) -> None:
        points, faces = join_meshes([(one.vertices, one.faces) for one in solids])
        numbers = np.arange(len(solids))
        normals = np.concatenate([np.reshape(one.corner_normals, (-1, 3, 3)) for one in solids])
        self._part_of_point = self._array(np.repeat(numbers, [len(one.vertices) for one in solids]), wp.int32)
        self._local = self._array(points, wp.vec3f)
        self._part = np.repeat(numbers, [len(one.faces) for one in solids])
        self._scene = raster.Triangles()
        self._scene.point, self._scene.corner = wp.zeros_like(self._local), self._array(faces, wp.int32)
        self._scene.normal, self._scene.part = self._array(normals, wp.vec3f), self._array(self._part, wp.int32)

    def _array(self, values: Any, dtype: Any) -> Any:
        return wp.array(np.asarray(values), dtype=dtype, device=self._device)

    def _keys(self, count: int, height: int, width: int) -> Any:
        return wp.empty((count, height, width), dtype=wp.int64, device=self._device)

    def _poses(self, state: Floats, object_pose: Floats, neighbour_pose: Floats, yaw: float) -> Floats:
        """Return poses (T, P, 7) of all solids; `yaw` turns the table [rad]."""
        placed = [object_pose, *(neighbour_pose[:, m] for m in range(len(self._objects) - 1))]
        centred = [to_centred_frame(pose, one.centre) for pose, one in zip(placed, self._objects, strict=True)]
        slabs = np.tile(slab_poses(self._supports, centred[0][0, :3], yaw), (len(state), 1, 1))
        robot = [poses[:, drawn_bodies(model)] for model, poses in self._robot.poses(state)]
        return np.concatenate([slabs, np.stack(centred, axis=1), *robot], axis=1)

    def _place(self, poses: Floats) -> None:
        self._scene.pose = self._array(_quat_last(poses), wp.transformf)
        inputs = [self._part_of_point, self._local, self._scene.pose]
        wp.launch(raster.move, len(self._local), inputs, [self._scene.point], device=self._device)

    def _views(self, poses: Floats, angles: Sequence[float], keys: Any, still: Sequence[bool] | None = None) -> Any:
        """Return cameras (C, 7) with vertical fields of view [rad] for the samples of `keys`."""
        views = _view_structs(poses)
        views["focal"] = 0.5 * keys.shape[1] / np.tan(0.5 * np.asarray(angles))
        views["still"] = False if still is None else still
        return self._array(views, raster.View)

    def _cover(self, views: Any, keys: Any, first_part: int = 0) -> None:
        keys.fill_(raster.NONE)
        inputs = [self._scene, len(self._supports), first_part, views]
        wp.launch(raster.cover, (len(views), len(self._part)), inputs, [keys], device=self._device)

    def _read(self, keys: Any) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
        """Return part, -1 for none, and depth [m], 0 for none, of each sample."""
        found = keys.numpy()
        none = found == np.iinfo(np.int64).max
        depth = (found >> 32).astype(np.int32).view(np.float32)
        return np.where(none, -1, self._part[np.where(none, 0, found & (2**31 - 1))]), np.where(none, 0.0, depth)

    def _lights(self, middle: Floats, radius: float, rng: Generator) -> list[Any]:
        """Return the lights for `raster.shade`, whose shadow maps show a sphere."""
        lamp, toward = draw_lamp(rng), direction_of(rng.uniform(0, 2 * np.pi), rng.uniform(*LAMP))
        light = _LIGHT()
        for name in _LIGHT.vars:
            setattr(light, name, getattr(lamp, name))
        passes = light_passes(self.options.lights, toward)
        views = _view_structs(np.stack([_camera_pose(middle + _FAR_M * one.toward, middle) for one in passes]))
        views["parallel"], views["focal"] = True, 0.5 * _MAP / (radius + _SHADOW_M)
        towards = self._array([one.toward for one in passes], wp.vec3f)
        structs = struct_array(passes, exposure.LightPass, self._device)
        return [light, wp.vec3f(*toward), structs, towards, self._array(views, raster.View)]

    def _motion(self, episode: Episode, poses: Floats) -> tuple[Floats, float]:
        """Return middle and radius of a sphere around the palm and the object at start and end."""
        hand, thing = self._robot.hand, len(self._supports)
        corners = apply(poses[[0, -1], thing, None], self._objects[0].centred.hull_vertices).reshape(-1, 3)
        roots = self._robot.poses(episode.state[episode.phase > 0])[0][1][:, 0]
        points = np.concatenate([corners, apply(roots, hand.palm.centre)])
        middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
        return middle, float(np.linalg.norm(points - middle, axis=1).max()) + _MARGIN_M

    def _cameras(
        self, episode: Episode, poses: Floats, middle: Floats, radius: float, rng: Generator
    ) -> dict[str, Floats]:
        """Return poses (T, 7) of each camera."""
        roots = self._robot.poses(episode.state)[0][1][:, 0]
        seconds = (np.arange(len(roots)) - 0.5 * len(roots)) / self.options.fps
        eye, aim = self._find_scene_camera(poses, middle, radius, rng)
        offset = np.append(rng.uniform(-MOUNT_M, MOUNT_M, 3), IDENTITY_POSE[3:])
        found = {}
        for name in self.options.cameras:
            if name == "wrist":
                found[name] = compose(roots, compose(self._mount, offset))
                continue
            angle = ORBIT_RAD_S * seconds * (name == "moving")
            eyes = aim + quat_rotate(quat_from_axis_angle(np.array([0, 0, 1.0]), angle), eye - aim)
            found[name] = np.stack([_camera_pose(one, aim) for one in eyes])
        return found

    def _find_scene_camera(self, poses: Floats, middle: Floats, radius: float, rng: Generator) -> tuple[Floats, Floats]:
        """Return place (3,) and aim (3,): of a few draws, those whose worst moment shows most of the object."""
        draws = []
        for _ in range(_DRAWS):
            aim = middle + rng.uniform(-AIM_M, AIM_M, 3)
            far = distance_to_fill(radius, VIEWS["scene"], rng.uniform(*FILL))
            draws.append((aim + far * direction_of(rng.uniform(0, 2 * np.pi), rng.uniform(*ELEVATION)), aim))
        cameras, shares = np.stack([_camera_pose(*one) for one in draws]), []
        for t in np.linspace(0, len(poses) - 1, _MOMENTS).astype(int):
            self._place(poses[t])
            part, _ = self._glance(cameras, VIEWS["scene"])
            shares.append((part == len(self._supports)).mean(axis=(1, 2)))
        return draws[int(np.argmax(np.min(shares, axis=0)))]

    def _glance(self, poses: Floats, angle: float) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
        """Return parts and depths (C, H, W) seen by small cameras (C, 7)."""
        keys = self._keys(len(poses), *_GLANCE)
        self._cover(self._views(poses, [angle] * len(poses), keys), keys)
        return self._read(keys)

    def _find_mount(self, root: Floats) -> Floats:
        """Return the pose (7,) of the wrist camera in the frame of the hand's root link.
        Of the candidate places, which are outside of the palm, it is the one that sees most fingertips of the open hand
        and most of the room before the palm."""
        hand = self._robot.hand
        centre, approach = hand.palm.centre, hand.palm.approach
        corners = np.concatenate([piece.vertices for piece in hand.pieces if piece.body == 0]) - centre
        across = np.cross(approach, np.eye(3)[np.argmin(np.abs(approach))])
        across /= np.linalg.norm(across)
        target = centre + _AHEAD_M * approach
        places = []
        for angle in 2 * np.pi * np.arange(_SIDES) / _SIDES:
            side = np.cos(angle) * across + np.sin(angle) * np.cross(approach, across)
            edge = float((corners @ side).max())
            for beside in _BESIDE_M:
                for behind in _BEHIND_M:
                    eye = centre + (edge + beside) * side - behind * approach
                    places.append(_camera_pose(eye, target, side))
        part, depth = self._glance(compose(root, np.stack(places)), VIEWS["wrist"])
        inner = np.s_[:, _GLANCE[0] // 4 : -_GLANCE[0] // 4, _GLANCE[1] // 4 : -_GLANCE[1] // 4]
        reach = np.linalg.norm(np.stack(places)[:, :3] - target, axis=1)[:, None, None]
        free = ((part < 0) | (depth > reach))[inner].mean(axis=(1, 2))
        first = len(self._supports) + len(self._objects)
        tips = [first + k for k, body in enumerate(drawn_bodies(hand)) if body in hand.fingertips]
        seen = np.mean([(part == tip).any(axis=(1, 2)) for tip in tips], axis=0)
        return places[int(np.argmax(free + seen))]


def _quat_last(poses: Floats) -> NDArray[np.float32]:
    return np.asarray(poses[..., [0, 1, 2, 4, 5, 6, 3]], np.float32)


def _view_structs(poses: Floats) -> NDArray[Any]:
    views: NDArray[Any] = np.zeros(len(poses), _VIEW.numpy_dtype())
    views["place"], views["inverse"] = _quat_last(poses), _quat_last(invert(poses))
    return views


def _camera_pose(eye: Floats, target: Floats, up: Sequence[float] | Floats = (0.0, 0.0, 1.0)) -> Floats:
    return pose_from_matrix(np.asarray(np.linalg.inv(look_at(eye, target, up)), np.float64))


def import_av() -> Any:
    """Return PyAV. Raises InputError: it is not installed."""
    try:
        # The encoder reports its settings of each film unless its level is set before.
        os.environ.setdefault("SVT_LOG", "1")
        import av
    except ModuleNotFoundError:
        raise InputError("films need PyAV; install it: pip install 'graspd[film]'") from None
    return av


#: AV1 with a key frame every 10 frames; lossless FFV1 for depth and segmentation.
_AV1: Final = ("libsvtav1", "mp4", "yuv420p", {"preset": "12", "crf": "26", "g": "10", "svtav1-params": "lp=1"})
_FFV1: Final = {1: "gray", 2: "gray16le"}


def encode(pictures: NDArray[Any], fps: float) -> bytes:
    """Encode colours (T, H, W, 3) as AV1 in MP4, depth or labels (T, H, W) as FFV1 in Matroska.
    Raises InputError: PyAV is not installed."""
    av = import_av()
    colour = pictures.ndim == 4
    codec, container, format_, options = _AV1 if colour else ("ffv1", "matroska", _FFV1[pictures.itemsize], {})
    buffer = io.BytesIO()
    with av.open(buffer, "w", format=container) as out:
        stream = out.add_stream(codec, rate=round(fps), options=options)
        stream.height, stream.width, stream.pix_fmt, stream.thread_count = *pictures.shape[1:3], format_, 1
        for picture in pictures:
            out.mux(stream.encode(av.VideoFrame.from_ndarray(picture, "rgb24" if colour else format_)))
        out.mux(stream.encode())
    return buffer.getvalue()


def film_maker(
    base: Shard, options: FilmOptions, seed: int, run: ExecutionContext = DEFAULT_CONTEXT
) -> Callable[[Robot, Executions], Callable[[Episode], Episode]]:
    """Return a function that makes, for one thread, a function that adds films to an episode."""
    spec = scene_spec_of(base)

    def make(robot: Robot, found: Executions) -> Callable[[Episode], Episode]:
        supports = TABLE if spec is None else scene_supports(spec)
        neighbours = () if found.placed is None else tuple(one.obj for one in found.placed.neighbours)
        renderer = EpisodeRenderer(robot, found.obj, supports=supports, neighbours=neighbours, options=options)

        def add(episode: Episode) -> Episode:
            films = renderer.film(episode, (seed, episode.row), run)
            videos = dict[str, bytes]()
            for camera, taken in films.items():
                pictures = {"": taken.rgb, "_depth": taken.depth, "_segmentation": taken.segmentation}
                videos |= {camera + kind: encode(one, options.fps) for kind, one in pictures.items() if one is not None}
            return replace(episode, videos=videos, camera_pose={camera: taken.pose for camera, taken in films.items()})

        return add

    return make


def cameras_attribute(options: FilmOptions) -> Attribute:
    """Return the attribute `cameras` of a shard of episodes."""
    size = options.width, options.height
    matrix = {camera: intrinsics(*size, VIEWS[camera]).tolist() for camera in options.cameras}
    return json.dumps(
        {name: {"width": size[0], "height": size[1], "intrinsics": k, "codec": "av1"} for name, k in matrix.items()}
    )
