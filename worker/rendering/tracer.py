"""A tracer: the same few solids in many worlds, traced by Newton's camera sensor, all pictures in one launch.

A picture is a sum of passes. Every pass sends one ray through each pixel with one directional light; rays move inside
the pixel (anti-aliasing) and the light moves over the lamp's disc or over the sky (soft shadows). Pass 0 goes through
the pixel centres: depth, normals and shape indices come from it alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Final

import newton
import numpy as np
import warp as wp
from newton.sensors import SensorCamera
from numpy.typing import NDArray

from service.model.errors import TaskCancelled
from service.model.pinhole import pixel_rays
from service.model.transforms import compose, pose_from_matrix, quat_from_axis_angle, quat_rotate
from worker.engines import backend
from worker.rendering import kernels
from worker.rendering.cameras import Floats
from worker.rendering.passes import LightPass, light_passes
from worker.rendering.scenery import Box, Lamp, Look, Pictures, Shot, Solid
from worker.run import ALONE, Run

#: The camera frame of the tracer (x right, y up, looks down -z) in the camera frame used here.
_FLIP: Final = np.diag([1.0, -1.0, -1.0, 1.0])
NO_SHAPE: Final = 0xFFFFFFFF
#: Pixels of one launch: image buffers take 64 bytes each.
PIXELS_TOGETHER: Final = 4_000_000


@dataclass
class Tracer:
    """Solids in `worlds` worlds. Build once, then `place` and `shoot` as often as wanted.

    Args:
        solids: the P solids of each world, same in every world.
        worlds: number of worlds.
        device: Warp device.
    """

    solids: Sequence[Solid | Box]
    worlds: int
    device: str
    _model: Any = field(init=False, repr=False)
    _sensor: Any = field(init=False, repr=False)
    _poses: Floats = field(init=False, repr=False)
    _materials: Any = field(init=False, repr=False)

    def __post_init__(self) -> None:
        backend.start()
        builder = newton.ModelBuilder()
        config = newton.ModelBuilder.ShapeConfig(has_shape_collision=False, has_particle_collision=False, density=0.0)
        meshes = [_tracer_mesh(solid) if isinstance(solid, Solid) else solid for solid in self.solids]
        for _ in range(self.worlds):
            builder.begin_world()
            for mesh in meshes:
                if isinstance(mesh, Box):
                    x, y, z = (0.5 * extent for extent in mesh.size)
                    builder.add_shape_box(-1, hx=x, hy=y, hz=z, cfg=config, color=(1.0, 1.0, 1.0))
                else:
                    builder.add_shape_mesh(-1, mesh=mesh, cfg=config, color=(1.0, 1.0, 1.0))
            builder.end_world()
        self._model = builder.finalize(device=self.device)
        self._state = self._model.state()
        self._sensor = SensorCamera(self._model, load_textures=False)
        self._config = SensorCamera.RenderConfig(
            enable_shadows=True, enable_ambient_lighting=False, enable_particles=False, max_distance=100.0,
            # One picture after the other: neighbouring rays meet the same part of one tree.
            render_order=SensorCamera.RenderOrder.VIEW_PRIORITY,
        )  # fmt: skip
        self._clear = SensorCamera.ClearData(clear_depth=float("inf"), clear_shape_index=NO_SHAPE)
        self._traced = False
        self._poses = np.zeros((self.worlds, len(self.solids), 7))
        self._poses[..., 3] = 1.0

    def place(self, poses: Floats, looks: Sequence[Sequence[Look]]) -> None:
        """Puts the solids where they belong.

        Args:
            poses: (worlds, P, 7) of each solid in its world.
            looks: for each world the P materials.
        """
        self._poses = np.asarray(poses, float)
        self._materials = wp.array(
            [_material(look) for world in looks for look in world], dtype=kernels.Material, device=self.device
        )

    def shoot(
        self,
        shot: Shot,
        run: Run = ALONE,
    ) -> Pictures:
        """Traces all cameras, `PIXELS_TOGETHER` pixels at a time.

        Args:
            shot: cameras and light.
            run: its threads share the views, a GPU takes all at once; told of pictures done, and asked before every
                pass whether to stop.

        Raises:
            TaskCancelled: `run.cancelled()` answered True.
        """
        self._turn(shot.turn)
        parts = self._parts(shot, run.cores)
        done: list[Pictures] = []
        for group in parts:
            exposures = [_Exposure(self, shot, views) for views in group]
            self._expose(exposures, shot, len(done) / sum(map(len, parts)), 1 / len(parts), run)
            done += [exposure.pictures(shot.samples) for exposure in exposures]
        names = ("rgb", "depth", "shape", "normal") if shot.normals else ("rgb", "depth", "shape")
        return Pictures(*(np.concatenate([getattr(p, name) for p in done]) for name in names))

    def _parts(self, shot: Shot, threads: int) -> list[list[NDArray[np.intp]]]:
        """Views of each launch, grouped into those that run at the same time."""
        together = 1 if wp.get_device(self.device).is_cuda else threads
        views = np.arange(len(shot.extrinsics))
        groups = -(-len(views) * shot.width * shot.height // PIXELS_TOGETHER)
        return [
            [part for part in np.array_split(group, together) if len(part)] for group in np.array_split(views, groups)
        ]

    def _expose(
        self,
        exposures: list[_Exposure],
        shot: Shot,
        done: float,
        share: float,
        run: Run,
    ) -> None:
        """All passes of some exposures, in step: a pass has one lamp."""
        with ThreadPoolExecutor(len(exposures)) as pool:
            for number, one in enumerate(light_passes(shot.samples, shot.toward_lamp)):
                if run.cancelled():
                    raise TaskCancelled(f"cancelled after {number} of {shot.samples} passes")
                rays = _rays(shot, one.shift, self.device)
                self._sensor.create_default_light(enable_shadows=True, direction=wp.vec3f(*-one.toward))
                # The first trace of a stage compiles its kernels: one thread must do that alone.
                trace = partial(_trace, rays=rays, one=one, first=number == 0)
                list(pool.map(trace, exposures) if self._traced else map(trace, exposures))
                self._traced = True
                ready = done + share * (number + 1) / shot.samples
                run.progress(ready * len(shot.world), len(shot.world), f"rendering {len(shot.world)} pictures")

    def _turn(self, turn: Floats) -> None:
        """Turns the worlds under the lamp and refits the tracer's tree."""
        poses = _xyzw(compose(_turns(turn)[:, None], self._poses)).reshape(-1, 7)
        self._model.shape_transform.assign(poses)
        self._model.bvh_refit_shapes(self._state)

    def _cameras(self, shot: Shot, part: NDArray[np.intp]) -> Any:
        """Tracer poses of some of the cameras in the turned worlds."""
        inverse = np.asarray(np.linalg.inv(shot.extrinsics[part]) @ _FLIP, np.float64)
        poses = compose(_turns(shot.turn)[shot.world[part]], pose_from_matrix(inverse))
        return wp.array(_xyzw(poses), dtype=wp.transformf, device=self.device)


class _Exposure:
    """Image buffers of some views, and the passes summed in them so far."""

    def __init__(self, stage: Tracer, shot: Shot, views: NDArray[np.intp]) -> None:
        self._stage, self._shot = stage, shot
        self._unturn = _turns(-shot.turn)[shot.world[views], 3:]
        sensor, device, world = stage._sensor, stage.device, shot.world[views]
        shape = (len(views), shot.height, shot.width)
        self._cameras = stage._cameras(shot, views)
        self._worlds = wp.array(world, dtype=wp.int32, device=device)
        self._lights = wp.array([_light(shot.lamps[w]) for w in world], dtype=kernels.Light, device=device)
        self._irradiance = sensor.allocate_image_color_hdr(len(views), shot.width, shot.height)
        self._depth = sensor.allocate_image_depth_forward(len(views), shot.width, shot.height)
        self._shape = sensor.allocate_image_shape_index(len(views), shot.width, shot.height)
        self._normal = sensor.allocate_image_normal(len(views), shot.width, shot.height)
        self._total = wp.zeros(shape, dtype=wp.vec3f, device=device)
        self._albedo = wp.zeros_like(self._total)
        self._seen = wp.full(shape, NO_SHAPE, dtype=wp.uint32, device=device)
        self._labels: tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.float32] | None] | None = None

    def trace(self, rays: Any, one: LightPass, first: bool) -> None:
        """Adds one pass; the first one leaves the labels."""
        stage, normal = self._stage, self._normal if self._shot.shaded else None
        stage._sensor.update(
            stage._state, self._cameras, rays, hdr_color_image=self._irradiance, forward_depth_image=self._depth,
            shape_index_image=self._shape, normal_image=normal, world_indices=self._worlds,
            clear_data=stage._clear, render_config=stage._config,
        )  # fmt: skip
        if self._shot.shaded:
            wp.launch(
                kernels.accumulate,
                dim=self._total.shape,
                inputs=[
                    stage._model.shape_transform, stage._materials,
                    rays, self._cameras, self._irradiance, self._depth, self._normal, self._shape, self._lights,
                    wp.vec3f(*one.toward), one.lamp_weight, one.sky_weight, first,
                ],
                outputs=[self._seen, self._albedo, self._total],
                device=stage.device,
            )  # fmt: skip
        if first:
            shape = self._shape.numpy()
            index = np.where(shape == NO_SHAPE, -1, shape.astype(np.int64) % len(stage.solids))
            self._labels = np.array(self._depth.numpy()), index, self._normals(index) if self._shot.normals else None

    def _normals(self, index: NDArray[np.int64]) -> NDArray[np.float32]:
        """Normals in the frame of the worlds as they were before they were turned under the lamp."""
        normals = np.where(index[..., None] >= 0, self._normal.numpy(), 0.0)
        back = quat_rotate(self._unturn[:, None, None], normals)
        return np.asarray(back / np.maximum(np.linalg.norm(back, axis=-1, keepdims=True), 1e-12), np.float32)

    def pictures(self, samples: int) -> Pictures:
        """The mean over the passes, developed."""
        assert self._labels is not None
        rgb = wp.empty((*self._total.shape, 3), dtype=wp.uint8, device=self._total.device)
        wp.launch(
            kernels.develop,
            dim=self._total.shape,
            inputs=[self._total, 1.0 / samples],
            outputs=[rgb],
            device=self._total.device,
        )
        return Pictures(np.array(rgb.numpy()), *self._labels)


def _trace(exposure: _Exposure, *, rays: Any, one: LightPass, first: bool) -> None:
    exposure.trace(rays, one, first)


def _turns(angle: Floats) -> Floats:
    poses = np.zeros((len(angle), 7))
    poses[:, 3:] = quat_from_axis_angle(np.array([0.0, 0.0, 1.0]), angle)
    return poses


def _tracer_mesh(solid: Solid) -> Any:
    # One vertex per face corner: normals may then jump at creases.
    corners = np.asarray(solid.vertices, np.float32)[solid.faces.ravel()]
    return newton.Mesh(
        corners,
        np.arange(len(corners), dtype=np.int32),
        normals=np.asarray(solid.corner_normals, np.float32).reshape(-1, 3),
        compute_inertia=False,
    )


def _xyzw(poses: Floats) -> NDArray[np.float32]:
    return np.asarray(poses[..., [0, 1, 2, 4, 5, 6, 3]], np.float32)


def _material(look: Look) -> Any:
    material = kernels.Material()
    material.base, material.second = wp.vec3f(*look.base), wp.vec3f(*look.second)
    material.pattern, material.scale = look.pattern, look.scale
    material.roughness, material.metalness = look.roughness, look.metalness
    return material


def _light(lamp: Lamp) -> Any:
    light = kernels.Light()
    for name in ("key", "sky", "ground", "backdrop_low", "backdrop_high"):
        setattr(light, name, wp.vec3f(*getattr(lamp, name)))
    return light


def _rays(shot: Shot, shift: tuple[float, float], device: str) -> Any:
    directions = pixel_rays(shot.intrinsics, shot.width, shot.height, shift) @ _FLIP[:3, :3]
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    bundle = np.zeros((shot.height, shot.width, 1, 2, 3), np.float32)
    bundle[:, :, 0, 1] = directions
    return wp.array(bundle, dtype=wp.vec3f, device=device)
