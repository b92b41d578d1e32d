"""A ray tracer: the same few solids in many worlds, all passes of a picture in one launch.

A picture is a sum of passes. Every pass sends one ray through each pixel with one directional light. Rays vary inside
the pixel (anti-aliasing), and the light varies over the lamp's disc or over the sky (soft shadows). Pass 0 goes through
the pixel centres; depth, normals and shape indices come from it alone."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import warp as wp
from numpy.typing import NDArray

from graspd.service.model import transforms
from graspd.service.model.transforms import Floats, apply, quat_rotate, quat_to_matrix
from graspd.worker.engines import backend
from graspd.worker.execution_context import DEFAULT_CONTEXT, ExecutionContext
from graspd.worker.rendering.annotate import box_corners
from graspd.worker.rendering.kernels import exposure, rays
from graspd.worker.rendering.kernels.shading import Light, Material
from graspd.worker.rendering.scenery import Appearance, Box, CameraShot, Pictures, Solid

#: Pixels between two cancellation checks: a fifth of a second for a core, and a number that fits into a GPU.
PIXELS_OF_A_CORE: Final = 100_000
PIXELS_OF_A_GPU: Final = 4_000_000
#: Margin of bounds around their solid, so that rounding in float32 loses no ray [m].
_SLACK_M: Final = 1e-5
_PLACED: Final[Any] = rays.PlacedSolid
LAMP_RADIUS: Final = np.radians(3.5)  # radius of the lamp's disc as seen from the table [rad]
#: Sine of the elevation above which the sky shines.
SKY_EDGE: Final = 0.35
_GOLDEN: Final = np.pi * (3.0 - np.sqrt(5.0))
#: Steps of the R2 sequence (Roberts 2018): few points, evenly spread.
_R2: Final = np.array([0.7548776662466927, 0.5698402909980532])


class Tracer:
    """Solids in many worlds. Build once, then `place` and `render` repeatedly."""

    def __init__(self, solids: Sequence[Solid | Box], device: str) -> None:
        """Load the P solids of every world to a Warp device."""
        backend.start_warp()
        self.device = device
        shapes: NDArray[Any] = np.zeros(len(solids), _PLACED.numpy_dtype())
        corners = list[Floats]()
        self._meshes, normals, first = list[Any](), [np.zeros((0, 3))], 0  # the meshes keep the shapes' trees alive
        for k, solid in enumerate(solids):
            if isinstance(solid, Box):
                shapes["half"][k] = half = 0.5 * np.asarray(solid.size)
                corners.append(box_corners(np.stack([-half, half])))
            else:
                corners.append(box_corners(solid.vertices))
                points = wp.array(np.asarray(solid.vertices, np.float32), dtype=wp.vec3f, device=device)
                faces = wp.array(np.ravel(solid.faces).astype(np.int32), dtype=wp.int32, device=device)
                self._meshes.append(wp.Mesh(points, faces))
                normals.append(np.reshape(solid.corner_normals, (-1, 3)))
                shapes["mesh"][k], shapes["first_corner"][k] = self._meshes[-1].id, first
                first += len(normals[-1])
        self._shapes = shapes
        self._corner_normals: Any = wp.array(np.concatenate(normals), dtype=wp.vec3f, device=device)
        self._corners = np.stack(corners)

    def place(self, poses: Floats, looks: Sequence[Sequence[Appearance]]) -> None:
        """Place the solids in their worlds: poses (worlds, P, 7), and for each world the P materials."""
        poses = np.asarray(poses, float)
        corners = apply(poses[:, :, None], self._corners)
        placed = np.tile(self._shapes, (len(poses), 1))
        placed["place"], placed["turn"] = poses[..., :3], np.swapaxes(quat_to_matrix(poses[..., 3:]), -1, -2)
        placed["lower"], placed["upper"] = corners.min(axis=2) - _SLACK_M, corners.max(axis=2) + _SLACK_M
        self._placed: Any = wp.array(placed, dtype=_PLACED, device=self.device)
        every = struct_array([look for world in looks for look in world], Material, self.device)
        self._materials: Any = every.reshape(poses.shape[:2])

    def render(self, shot: CameraShot, run: ExecutionContext = DEFAULT_CONTEXT) -> Pictures:
        """Trace all cameras.
        The threads of `run` share the rows of each picture; a GPU takes many pictures at once. `run` receives the
        number of finished pictures. Raises TaskCancelled: `run.cancelled()` returned True; polled before launches."""
        cuda = wp.get_device(self.device).is_cuda
        threads = 1 if cuda else min(run.cores, shot.height)
        count, pixels = len(shot.world), len(shot.world) * shot.height * shot.width
        launches = -(-pixels // (PIXELS_OF_A_GPU if cuda else PIXELS_OF_A_CORE * threads))
        film, exposed = _ShotRenderer(self, shot), []
        with ThreadPoolExecutor(threads, thread_name_prefix="rendering") as pool:
            for views in np.array_split(np.arange(count), min(count, launches)):
                run.check("the rendering")
                exposed.append(film.render_views(views, threads, pool))
                run.progress(float(views[-1] + 1), float(count), f"rendering {count} pictures")
        rgb, depth, shape, normal = (np.concatenate(parts) for parts in zip(*exposed, strict=True))
        return Pictures(rgb, depth, shape.astype(np.int64), normal if shot.normals else None)


class _ShotRenderer:
    """Pictures of one shot, exposed a few views at a time."""

    def __init__(self, tracer: Tracer, shot: CameraShot) -> None:
        self._tracer, self._shot, device = tracer, shot, tracer.device
        passes = light_passes(shot.samples, shot.toward_lamp)
        self._passes = struct_array(passes, exposure.LightPass, device)
        # Worlds turn under the lamp, so in their frames lamp and sky turn in the opposite direction.
        back = transforms.quat_from_axis_angle(np.array([0.0, 0.0, 1.0]), -np.asarray(shot.turn))
        toward = quat_rotate(back[:, None], np.array([one.toward for one in passes]))
        self._toward = wp.array(toward, dtype=wp.vec3f, device=device)
        poses = transforms.pose_from_matrix(np.asarray(np.linalg.inv(shot.extrinsics), np.float64))
        self._cameras = np.asarray(poses[..., [0, 1, 2, 4, 5, 6, 3]], np.float32)

    def render_views(self, views: NDArray[np.intp], threads: int, pool: ThreadPoolExecutor) -> tuple[NDArray[Any], ...]:
        """Return colour, depth, shapes and normals of some views; each thread takes rows of all pictures."""
        tracer, shot, device = self._tracer, self._shot, self._tracer.device
        size, world, k = (len(views), shot.height, shot.width), shot.world[views], shot.intrinsics
        rgb = wp.zeros((*size, 3), dtype=wp.uint8, device=device)
        depth, shape = (wp.empty(size, dtype=kind, device=device) for kind in (wp.float32, wp.int32))
        normal = wp.empty(size if shot.normals else (0, 0, 0), dtype=wp.vec3f, device=device)
        inputs = [
            tracer._placed,
            tracer._corner_normals,
            tracer._materials,
            wp.array(world, dtype=wp.int32, device=device),
            wp.array(self._cameras[views], dtype=wp.transformf, device=device),
            struct_array([shot.lamps[w] for w in world], Light, device),
            wp.vec2f(k[0, 0], k[1, 1]),
            wp.vec2f(k[0, 2], k[1, 2]),
            self._passes,
            self._toward,
            shot.shaded,
            threads,
        ]
        outputs = [rgb, depth, shape, normal]

        def render_rows(first: int) -> None:
            dim = (size[0], len(range(first, size[1], threads)), size[2])
            wp.launch(exposure.expose, dim=dim, inputs=[*inputs, first], outputs=outputs, device=device)

        list(pool.map(render_rows, range(threads)))
        return tuple(array.numpy() for array in outputs)


def struct_array(things: Sequence[Any], struct: Any, device: str) -> Any:
    """Return an array of Warp structs, filled from attributes of equal names."""
    kind = np.dtype(struct.numpy_dtype())
    rows = [tuple(getattr(thing, name) for name in kind.names or ()) for thing in things]
    return wp.array(np.array(rows, kind), dtype=struct, device=device)


@dataclass(frozen=True)
class LightPass:
    """One ray through every pixel, one directional light."""

    shift: tuple[float, float]  # offset of the ray from the pixel's centre [px]
    toward: Floats  # (3,) unit direction to the light
    lamp_weight: float  # weights such that the mean over all passes is one lamp and one sky
    sky_weight: float


def light_passes(samples: int, toward_lamp: Floats) -> list[LightPass]:
    """Return passes alternating between the lamp's disc and the sky; pass 0 is at pixel centres."""
    lamp_passes, sky_passes = (samples + 1) // 2, samples // 2
    # An open horizontal surface receives 1 from the whole sky.
    sky = 2.0 / (1.0 + SKY_EDGE) * samples / max(1, sky_passes)
    passes = []
    for k in range(samples):
        across, down = ((0.5 + k * _R2) % 1.0 - 0.5).tolist()
        if k % 2 == 0:
            lamp = _disc_direction(toward_lamp, k // 2, lamp_passes)
            passes.append(LightPass((across, down), lamp, samples / lamp_passes, 0.0))
        else:
            passes.append(LightPass((across, down), _sky_direction(k // 2, sky_passes), 0.0, sky))
    return passes


def _disc_direction(axis: Floats, k: int, count: int) -> Floats:
    radius, angle = LAMP_RADIUS * np.sqrt((k + 0.5) / count), _GOLDEN * k
    side = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    direction = axis + radius * (np.cos(angle) * side + np.sin(angle) * np.cross(axis, side))
    return np.asarray(direction / np.linalg.norm(direction))


def _sky_direction(k: int, count: int) -> Floats:
    # Uniform over the sky above the haze of the horizon, since low lights would cast long streaks.
    height, angle = 1.0 - (1.0 - SKY_EDGE) * (k + 0.5) / count, _GOLDEN * k
    level = np.sqrt(1.0 - height**2)
    return np.array([level * np.cos(angle), level * np.sin(angle), height])
