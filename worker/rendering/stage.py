"""A stage: the same few solids in many worlds, traced by Newton's camera sensor, all pictures in one launch.

A picture is a sum of passes. Every pass sends one ray through each pixel with one directional light; rays move inside
the pixel (anti-aliasing) and the light moves over the lamp's disc or over the sky (soft shadows). Pass 0 goes through
the pixel centres: depth, normals and shape indices come from it alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import newton
import numpy as np
import warp as wp
from newton.sensors import SensorCamera
from numpy.typing import NDArray

from service.errors import TaskCancelled
from worker.rendering import kernels
from worker.rendering.cameras import Floats, pixel_rays
from worker.transforms import compose, pose_from_matrix, quat_from_axis_angle

#: Radius of the lamp's disc seen from the table [rad].
LAMP_RADIUS: Final = np.radians(3.5)
#: Sine of the elevation above which the sky shines.
SKY_EDGE: Final = 0.35
#: The camera frame of the tracer (x right, y up, looks down -z) in the camera frame used here.
_FLIP: Final = np.diag([1.0, -1.0, -1.0, 1.0])
NO_SHAPE: Final = 0xFFFFFFFF
#: Pixels of one launch: image buffers take 64 bytes each.
PIXELS_TOGETHER: Final = 4_000_000


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
class Look:
    """Material of one solid. Colours are linear RGB."""

    base: tuple[float, float, float]
    second: tuple[float, float, float] = (0.0, 0.0, 0.0)
    pattern: int = kernels.PLAIN
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
    """What V cameras see."""

    rgb: NDArray[np.uint8]
    """(V, H, W, 3) sRGB"""
    depth: NDArray[np.float32]
    """(V, H, W) along the optical axis [m]; inf: nothing."""
    shape: NDArray[np.int64]
    """(V, H, W) index of the solid seen through the pixel's centre; -1: nothing."""


@dataclass(frozen=True)
class Shot:
    """Which world each camera looks into, and how the light falls."""

    world: NDArray[np.int32]
    """(V,)"""
    extrinsics: Floats
    """(V, 4, 4) world to camera: x right, y down, z forward."""
    intrinsics: Floats
    width: int
    height: int
    samples: int
    toward_lamp: Floats
    """(3,) unit; in the frame in which worlds are turned by `turn`."""
    turn: Floats
    """(worlds,) angle about z by which each world is turned under the lamp [rad]."""
    lamps: Sequence[Lamp]
    """One per world."""


@dataclass
class Stage:
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
            enable_shadows=True, enable_ambient_lighting=False, enable_particles=False, max_distance=100.0
        )
        self._clear = SensorCamera.ClearData(clear_depth=float("inf"), clear_shape_index=NO_SHAPE)
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
        self, shot: Shot, *, tick: Callable[[float], None] | None = None, cancelled: Callable[[], bool]
    ) -> Pictures:
        """Traces all cameras, `PIXELS_TOGETHER` pixels in a launch.

        Raises:
            TaskCancelled: `cancelled()` answered True between two passes.
        """
        self._turn(shot.turn)
        views = len(shot.extrinsics)
        together = max(1, PIXELS_TOGETHER // (shot.width * shot.height))
        parts = []
        for start in range(0, views, together):
            done, share = start / views, min(together, views - start) / views

            def inner(fraction: float, done: float = done, share: float = share) -> None:
                if tick is not None:
                    tick(done + share * fraction)

            parts.append(self._expose(shot, slice(start, start + together), inner, cancelled))
        return Pictures(*(np.concatenate([getattr(p, name) for p in parts]) for name in ("rgb", "depth", "shape")))

    def _expose(
        self, shot: Shot, part: slice, tick: Callable[[float], None], cancelled: Callable[[], bool]
    ) -> Pictures:
        """All passes of some of the views."""
        world = shot.world[part]
        cameras = self._cameras(shot, part)
        film = _Film(self._sensor, (len(world), shot.height, shot.width))
        worlds = wp.array(world, dtype=wp.int32, device=self.device)
        lights = wp.array([_light(shot.lamps[w]) for w in world], dtype=kernels.Light, device=self.device)
        first: tuple[NDArray[np.float32], NDArray[np.int64]] | None = None
        for number, (shift, toward, key, sky) in enumerate(_passes(shot)):
            if cancelled():
                raise TaskCancelled(f"cancelled after {number} of {shot.samples} passes")
            rays = _rays(shot, shift, self.device)
            self._sensor.create_default_light(enable_shadows=True, direction=wp.vec3f(*-toward))
            self._sensor.update(
                self._state, cameras, rays, hdr_color_image=film.irradiance, forward_depth_image=film.depth,
                shape_index_image=film.shape, normal_image=film.normal, world_indices=worlds,
                clear_data=self._clear, render_config=self._config,
            )  # fmt: skip
            wp.launch(
                kernels.accumulate,
                dim=film.total.shape,
                inputs=[
                    rays, cameras, film.irradiance, film.depth, film.normal, film.shape, self._model.shape_transform,
                    self._materials, lights, wp.vec3f(*toward), key, sky, number == 0,
                ],
                outputs=[film.seen, film.albedo, film.total],
                device=self.device,
            )  # fmt: skip
            if first is None:
                first = film.depth.numpy().copy(), self._solid_index(film.shape.numpy())
            tick((number + 1) / shot.samples)
        assert first is not None
        return Pictures(film.develop(shot.samples), *first)

    def _turn(self, turn: Floats) -> None:
        """Turns the worlds under the lamp and refits the tracer's tree."""
        poses = _xyzw(compose(_turns(turn)[:, None], self._poses)).reshape(-1, 7)
        self._model.shape_transform.assign(poses)
        self._model.bvh_refit_shapes(self._state)

    def _cameras(self, shot: Shot, part: slice) -> Any:
        """Tracer poses of some of the cameras in the turned worlds."""
        inverse = np.asarray(np.linalg.inv(shot.extrinsics[part]) @ _FLIP, np.float64)
        poses = compose(_turns(shot.turn)[shot.world[part]], pose_from_matrix(inverse))
        return wp.array(_xyzw(poses), dtype=wp.transformf, device=self.device)

    def _solid_index(self, shape: NDArray[np.uint32]) -> NDArray[np.int64]:
        return np.where(shape == NO_SHAPE, -1, shape.astype(np.int64) % len(self.solids))


class _Film:
    """Image buffers of some views."""

    def __init__(self, sensor: Any, shape: tuple[int, int, int]) -> None:
        views, height, width = shape
        self.irradiance = sensor.allocate_image_color_hdr(views, width, height)
        self.depth = sensor.allocate_image_depth_forward(views, width, height)
        self.shape = sensor.allocate_image_shape_index(views, width, height)
        self.normal = sensor.allocate_image_normal(views, width, height)
        self.total = wp.zeros(shape, dtype=wp.vec3f, device=sensor.device)
        self.albedo = wp.zeros_like(self.total)
        self.seen = wp.full(shape, NO_SHAPE, dtype=wp.uint32, device=sensor.device)

    def develop(self, samples: int) -> NDArray[np.uint8]:
        """(V, H, W, 3) sRGB of the mean over the passes."""
        rgb = wp.empty((*self.total.shape, 3), dtype=wp.uint8, device=self.total.device)
        wp.launch(
            kernels.develop,
            dim=self.total.shape,
            inputs=[self.total, 1.0 / samples],
            outputs=[rgb],
            device=self.total.device,
        )
        return np.array(rgb.numpy())


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


def _passes(shot: Shot) -> list[tuple[tuple[float, float], Floats, float, float]]:
    """Shift inside the pixel, direction towards the light, weight of lamp and sky, of each pass.

    Shifts follow the R2 sequence (Roberts 2018), lamp and sky points a sunflower spiral, so few passes spread evenly.
    """
    step = np.array([0.7548776662466927, 0.5698402909980532])
    samples = shot.samples
    key_passes, sky_passes = (samples + 1) // 2, samples // 2
    passes = []
    for k in range(samples):
        shift = (0.0, 0.0) if k == 0 else tuple((0.5 + k * step) % 1.0 - 0.5)
        if k % 2 == 0:
            toward = _on_disc(shot.toward_lamp, k // 2, key_passes)
            passes.append((shift, toward, samples / key_passes, 0.0))
        else:
            # Weighted so that an open horizontal surface receives 1 from the whole sky.
            passes.append((shift, _on_sky(k // 2, sky_passes), 0.0, 2.0 / (1.0 + SKY_EDGE) * samples / sky_passes))
    return passes


_GOLDEN: Final = np.pi * (3.0 - np.sqrt(5.0))


def _on_disc(axis: Floats, k: int, count: int) -> Floats:
    radius, angle = LAMP_RADIUS * np.sqrt((k + 0.5) / count), _GOLDEN * k
    side = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    direction = axis + radius * (np.cos(angle) * side + np.sin(angle) * np.cross(axis, side))
    return np.asarray(direction / np.linalg.norm(direction))


def _on_sky(k: int, count: int) -> Floats:
    # Uniform over the sky above the horizon haze: low lights would draw long streaks.
    height, angle = 1.0 - (1.0 - SKY_EDGE) * (k + 0.5) / count, _GOLDEN * k
    level = np.sqrt(1.0 - height**2)
    return np.array([level * np.cos(angle), level * np.sin(angle), height])


def _rays(shot: Shot, shift: tuple[float, float], device: str) -> Any:
    directions = pixel_rays(shot.intrinsics, shot.width, shot.height, shift) @ _FLIP[:3, :3]
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    bundle = np.zeros((shot.height, shot.width, 1, 2, 3), np.float32)
    bundle[:, :, 0, 1] = directions
    return wp.array(bundle, dtype=wp.vec3f, device=device)
