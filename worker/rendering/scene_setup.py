"""Setup of a render: cameras, materials and lights of each scene, and its tracers.

Materials and lights are random within plausible ranges."""

import colorsys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np
from cachetools import LRUCache
from numpy.random import Generator

from graspd.service.model.colours import Colour, linear_rgb, linear_rgb_from_hex
from graspd.service.model.scene_spec import Box as BoxSupport
from graspd.service.model.scene_spec import HalfSpace
from graspd.service.model.transforms import Floats, apply
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.objects.model import ObjectModel
from graspd.worker.rendering import cameras, scenery
from graspd.worker.rendering.cameras import SAMPLED, GivenCameras, stereo_pair
from graspd.worker.rendering.hands import DrawnHand
from graspd.worker.rendering.kernels.shading import GRAIN, PLAIN, SPECKLE, TILES
from graspd.worker.rendering.scenery import TABLE, Appearance, Box, CameraShot, Lamp, Pictures, Solid, Supports
from graspd.worker.rendering.tracer import Tracer

#: Largest number of further draws of a camera, and share of the object that it must see past the supports if possible.
_DRAWS: Final = 32
_SEEN: Final = 0.8
#: Height at which hidden solids are out of every picture [m].
_AWAY_M: Final = -50.0
_NOWHERE: Final = np.zeros((0, 3))
_tracers: LRUCache[tuple[object, ...], Tracer] = LRUCache(4)
_WOODS: Final = [("#b98a5a", "#8a5c34"), ("#d9b98c", "#b98f5e"), ("#7b5233", "#523320"), ("#a9978a", "#85736a")]
_STONES: Final = [("#c9c6c0", "#8f8b85"), ("#6f7478", "#45494d"), ("#d8d3c8", "#b5ad9f"), ("#86908a", "#5d6761")]
_CLOTHS: Final = ["#cfd3d6", "#e4ded2", "#9fb0b8", "#6d7f86", "#b7bda5", "#494f57", "#c9a98b"]
#: Pairs of colours, pattern, and range of the roughness of tables of wood, stone and tiles.
_TABLES: Final = (
    (_WOODS, GRAIN, (0.45, 0.8)),
    (_STONES, SPECKLE, (0.5, 0.8)),
    ([(base, "#8b8883") for base in _CLOTHS], TILES, (0.45, 0.7)),
)


@dataclass(frozen=True)
class CameraPlan:
    """Placement of the cameras of each scene."""

    views: int
    width: int
    height: int
    baseline_m: float | None  # baseline of stereo pairs [m]; None for single cameras
    given: GivenCameras = SAMPLED

    @property
    def intrinsics(self) -> Floats:
        return cameras.intrinsics(self.width, self.height) if self.given.intrinsics is None else self.given.intrinsics

    @property
    def placements(self) -> int:
        return self.views if self.given.extrinsics is None else len(self.given.extrinsics)

    @property
    def eyes(self) -> int:
        return 1 if self.baseline_m is None else 2

    def extrinsics(
        self, centre: Floats, radius: float, rng: Generator, supports: Supports = (), points: Floats = _NOWHERE
    ) -> Floats:
        """Return extrinsics (placements * eyes, 4, 4) around a ball with a free view of the points.
        The left camera of a pair comes before the right one."""
        if self.given.extrinsics is not None:
            middles = list(self.given.extrinsics)
        else:
            cone = cameras.inscribed_field_of_view(self.intrinsics, self.width, self.height)
            draw = partial(cameras.sample_hemisphere, centre, radius, views=self.views, field_of_view=cone, rng=rng)
            middles = _unobstructed_cameras(draw, supports, points)
        if self.baseline_m is None:
            return np.stack(middles)
        return np.stack([eye for middle in middles for eye in stereo_pair(middle, self.baseline_m)])


class SceneSetup:
    """Scenes of one object, its neighbours and supports, ready for rendering."""

    def __init__(
        self,
        objects: Sequence[ObjectModel],
        poses: Floats,
        plan: CameraPlan,
        *,
        seed: int,
        samples: int,
        supports: Supports = TABLE,
    ) -> None:
        """`poses` (S, 1 + M, 7) of object and M neighbours in the scene frame; `supports` of all scenes."""
        self.objects, self.plan, self._slabs = objects, plan, scenery.slabs(supports)
        rngs = [np.random.default_rng([seed, s]) for s in range(len(poses))]
        scenes = [_Scene(objects, pose, plan, supports, rng) for pose, rng in zip(poses, rngs, strict=True)]
        self.object_pose = np.asarray(poses, float)[:, 0]
        self._poses = np.stack([scene.poses for scene in scenes])
        self.looks = [scene.looks for scene in scenes]
        # All scenes of a call share one height of the lamp. Each scene turns under it, so azimuths differ.
        elevation = np.radians(np.random.default_rng([seed, 2**31]).uniform(40.0, 65.0))
        self.shot = CameraShot(
            world=np.repeat(np.arange(len(poses), dtype=np.int32), plan.placements * plan.eyes),
            extrinsics=np.concatenate([scene.extrinsics for scene in scenes]),
            intrinsics=plan.intrinsics,
            width=plan.width,
            height=plan.height,
            samples=samples,
            toward_lamp=np.array([np.cos(elevation), 0.0, np.sin(elevation)]),
            turn=np.array([scene.turn for scene in scenes]),
            lamps=[scene.lamp for scene in scenes],
        )

    def render(self, run: ExecutionContext, *, normals: bool = False) -> Pictures:
        """Render the pictures; `Pictures.shape` is 0 for supports, 1 for the object, 2 + m for neighbour m."""
        return self._with_object_indices(self.stage(run.device).render(replace(self.shot, normals=normals), run))

    def render_object_alone(self, run: ExecutionContext) -> Pictures:
        """Trace one ray per pixel of the object alone; `Pictures.shape` is 1 where it is visible."""
        poses = self._poses.copy()
        poses[:, [k for k in range(poses.shape[1]) if k != len(self._slabs)], 2] = _AWAY_M
        return self._with_object_indices(
            self.stage(run.device, poses).render(replace(self.shot, samples=1, shaded=False), run)
        )

    def render_with_hand(self, drawn: DrawnHand, run: ExecutionContext) -> Pictures:
        key = (*self._key(), drawn.hand.content, drawn.wrist is not None, run.device)
        stage = _cached_tracer(key, lambda: [*self._solids(), *(part.solid for part in drawn.parts)], run.device)
        looks = [[*looks, *(part.look for part in drawn.parts)] for looks in self.looks]
        stage.place(np.concatenate([self._poses, drawn.body_poses()], axis=1), looks)
        return self._with_object_indices(stage.render(self.shot, run))

    def stage(self, device: str, poses: Floats | None = None) -> Tracer:
        stage = _cached_tracer((*self._key(), device), self._solids, device)
        stage.place(self._poses if poses is None else poses, self.looks)
        return stage

    def _with_object_indices(self, pictures: Pictures) -> Pictures:
        extra = len(self._slabs) - 1
        return replace(pictures, shape=np.where(pictures.shape < 0, -1, np.maximum(pictures.shape - extra, 0)))

    def _key(self) -> tuple[object, ...]:
        return (tuple(self._slabs), *(obj.content for obj in self.objects))

    def _solids(self) -> list[Solid | Box]:
        return [*self._slabs, *(Solid(obj.vertices, obj.faces, obj.corner_normals) for obj in self.objects)]


class _Scene:
    def __init__(
        self, objects: Sequence[ObjectModel], poses: Floats, plan: CameraPlan, supports: Supports, rng: Generator
    ) -> None:
        points = apply(poses[0], objects[0].hull_vertices)
        centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
        radius = float(np.linalg.norm(points - centre, axis=1).max())
        self.extrinsics = plan.extrinsics(centre, radius, rng, supports, points)
        table, thing = draw_table_look(rng), draw_object_look(rng)
        self.lamp = draw_lamp(rng)
        self.turn = float(rng.uniform(0, 2 * np.pi))
        yaw = rng.uniform(0, 2 * np.pi)
        self.poses = np.concatenate([scenery.slab_poses(supports, centre, yaw), poses])
        # Random draws for neighbours and walls come last, so that they do not change the appearance of the rest.
        others = [draw_object_look(rng) for _ in objects[1:]]
        walls = draw_table_look(rng) if len(supports) > 1 else table
        self.looks: list[Appearance] = [
            *(table if k == 0 or isinstance(s, HalfSpace) else walls for k, s in enumerate(supports)),
            thing,
            *others,
        ]


def _unobstructed_cameras(draw: Callable[[], list[Floats]], supports: Supports, points: Floats) -> list[Floats]:
    """Draw cameras that see the points past boxes; a camera without a free view is drawn again."""
    drawn = draw()
    if not any(isinstance(s, BoxSupport) for s in supports):
        return drawn

    def visible_share_from(camera: Floats) -> float:
        return scenery.visible_share(supports, -camera[:3, :3].T @ camera[:3, 3], points)

    share = [visible_share_from(camera) for camera in drawn]
    for _ in range(_DRAWS):
        if min(share) >= _SEEN:
            break
        for k, camera in enumerate(draw()):
            if share[k] < _SEEN and (found := visible_share_from(camera)) > share[k]:
                drawn[k], share[k] = camera, found
    return drawn


def _cached_tracer(key: tuple[object, ...], solids: Callable[[], Sequence[Solid | Box]], device: str) -> Tracer:
    if key not in _tracers:
        _tracers[key] = Tracer(solids(), device)
    return _tracers[key]


def hsv(hue: float, saturation: float, value: float) -> Colour:
    """Convert hue, saturation, value in 0..1 to linear RGB."""
    return linear_rgb(*colorsys.hsv_to_rgb(hue % 1.0, saturation, value))


def draw_table_look(rng: Generator) -> Appearance:
    """Draw wood, stone, tiles or a plain cloth."""
    kind = int(rng.integers(4))
    scale = float(rng.uniform(0.7, 1.5))
    if kind == 3:
        base = _CLOTHS[rng.integers(len(_CLOTHS))]
        return Appearance(linear_rgb_from_hex(base), pattern=PLAIN, roughness=float(rng.uniform(0.7, 0.95)))
    pairs, pattern, roughness = _TABLES[kind]
    main, second = map(linear_rgb_from_hex, pairs[rng.integers(len(pairs))])
    return Appearance(main, second, pattern, scale, float(rng.uniform(*roughness)))


def draw_object_look(rng: Generator) -> Appearance:
    """Draw a glazed, painted, brushed or speckled material of any hue."""
    hue, kind = float(rng.uniform()), int(rng.integers(4))
    base = hsv(hue, float(rng.uniform(0.3, 0.75)), float(rng.uniform(0.5, 0.9)))
    if kind == 0:
        return Appearance(base, roughness=float(rng.uniform(0.2, 0.35)))
    if kind == 1:
        return Appearance(hsv(hue, 0.15, 0.75), roughness=float(rng.uniform(0.35, 0.55)), metalness=1.0)
    if kind == 2:
        second = hsv(hue + float(rng.uniform(-0.08, 0.08)), 0.6, 0.45)
        return Appearance(base, second, SPECKLE, float(rng.uniform(1.0, 3.0)), float(rng.uniform(0.4, 0.7)))
    return Appearance(base, roughness=float(rng.uniform(0.5, 0.8)))


def draw_lamp(rng: Generator) -> Lamp:
    """Draw warm to cool light of random strength before a soft backdrop."""
    warmth, strength = float(rng.uniform(-1, 1)), float(rng.uniform(0.85, 1.15))
    tint = hsv(float(rng.uniform()), 0.12, float(rng.uniform(0.45, 0.8)))
    return Lamp(
        key=(strength * (1.5 + 0.15 * warmth), strength * 1.45, strength * (1.4 - 0.2 * warmth)),
        sky=(0.58 - 0.06 * warmth, 0.6, 0.64 + 0.06 * warmth),
        backdrop_low=(0.45 * tint[0], 0.45 * tint[1], 0.45 * tint[2]),
        backdrop_high=tint,
    )
