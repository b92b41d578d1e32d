"""What a render has before its cameras: what the seed decides about each scene, and the stages it is traced on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from cachetools import LRUCache

from service.model.transforms import apply
from worker.objects.model import Floats, ObjectModel
from worker.rendering.camera_file import SAMPLED, GivenCameras
from worker.rendering.cameras import intrinsics, narrow_field, sample_hemisphere, stereo_pair
from worker.rendering.hands import DrawnHand, drawn_bodies, hand_solids, look_of
from worker.rendering.palette import lamp, object_look, table_look
from worker.rendering.scenery import Box, Look, Pictures, Shot, Solid
from worker.rendering.tracer import Tracer

#: The table: a slab whose top is z = 0 [m].
from worker.run import Run

TABLE_SIZE: Final = (1.2, 0.9, 0.04)
#: Depth at which things wait that a pass does not show [m].
_AWAY_M: Final = -50.0
_stages: LRUCache[tuple[object, ...], Tracer] = LRUCache(4)


@dataclass(frozen=True)
class CameraPlan:
    """How the cameras of each scene are found."""

    views: int
    width: int
    height: int
    baseline_m: float | None
    """Of stereo pairs; None: mono."""
    given: GivenCameras = SAMPLED

    @property
    def intrinsics(self) -> Floats:
        return intrinsics(self.width, self.height) if self.given.intrinsics is None else self.given.intrinsics

    @property
    def placements(self) -> int:
        return self.views if self.given.extrinsics is None else len(self.given.extrinsics)

    @property
    def eyes(self) -> int:
        return 1 if self.baseline_m is None else 2

    def extrinsics(self, centre: Floats, radius: float, rng: np.random.Generator) -> Floats:
        """(placements * eyes, 4, 4) around a ball; left before right."""
        middles: Sequence[Floats]
        if self.given.extrinsics is not None:
            middles = list(self.given.extrinsics)
        else:
            cone = narrow_field(self.intrinsics, self.width, self.height)
            middles = sample_hemisphere(centre, radius, views=self.views, field_of_view=cone, rng=rng)
        if self.baseline_m is None:
            return np.stack(middles)
        return np.stack([eye for middle in middles for eye in stereo_pair(middle, self.baseline_m)])


class Setting:
    """Scenes of one object, its neighbours and a table, ready to be shot."""

    def __init__(
        self, objects: Sequence[ObjectModel], poses: Floats, plan: CameraPlan, *, seed: int, samples: int
    ) -> None:
        """`poses` (S, 1 + M, 7) of the object and its M neighbours in the table frame."""
        self.objects, self.plan = objects, plan
        scenes = [_Scene(objects, pose, plan, np.random.default_rng([seed, s])) for s, pose in enumerate(poses)]
        self.poses = np.stack([scene.poses for scene in scenes])
        self.looks = [scene.looks for scene in scenes]
        self.shot = Shot(
            world=np.repeat(np.arange(len(poses), dtype=np.int32), plan.placements * plan.eyes),
            extrinsics=np.concatenate([scene.extrinsics for scene in scenes]),
            intrinsics=plan.intrinsics, width=plan.width, height=plan.height, samples=samples,
            toward_lamp=_toward_lamp(np.random.default_rng([seed, 2**31])),
            turn=np.array([scene.turn for scene in scenes]), lamps=[scene.lamp for scene in scenes],
        )  # fmt: skip

    def shoot(self, run: Run, *, normals: bool = False) -> Pictures:
        """The pictures; `Pictures.shape` is 0 for the table, 1 for the object, 2 + m for neighbour m."""
        return self.stage(run.device).shoot(replace(self.shot, normals=normals), run)

    def shoot_alone(self, run: Run) -> Pictures:
        """One ray per pixel of the object with nothing around it; `Pictures.shape` is 1 where it is seen."""
        poses = self.poses.copy()
        poses[:, [k for k in range(poses.shape[1]) if k != 1], 2] = _AWAY_M
        return self.stage(run.device, poses).shoot(replace(self.shot, samples=1, shaded=False), run)

    def shoot_with(self, drawn: DrawnHand, run: Run) -> Pictures:
        """The same pictures with a hand in them."""
        key = (*_key(self.objects), drawn.hand.content, len(self.poses), run.device)
        stage = _kept(key, lambda: [*_solids(self.objects), *hand_solids(drawn.hand)], len(self.poses), run.device)
        shown = [look_of(drawn.hand, body) for body in drawn_bodies(drawn.hand)]
        stage.place(
            np.concatenate([self.poses, drawn.body_poses()], axis=1), [[*looks, *shown] for looks in self.looks]
        )
        return stage.shoot(self.shot, run)

    def stage(self, device: str, poses: Floats | None = None) -> Tracer:
        """The stage of these objects, kept for the next call with the same ones, with everything in its place."""
        key = (*_key(self.objects), len(self.poses), device)
        stage = _kept(key, lambda: _solids(self.objects), len(self.poses), device)
        stage.place(self.poses if poses is None else poses, self.looks)
        return stage


class _Scene:
    """What the seed decides about one scene."""

    def __init__(
        self, objects: Sequence[ObjectModel], poses: Floats, plan: CameraPlan, rng: np.random.Generator
    ) -> None:
        points = apply(poses[0], objects[0].hull_vertices)
        centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
        radius = float(np.linalg.norm(points - centre, axis=1).max())
        self.extrinsics = plan.extrinsics(centre, radius, rng)
        self.looks: list[Look] = [table_look(rng), object_look(rng)]
        self.lamp = lamp(rng)
        self.turn = float(rng.uniform(0, 2 * np.pi))
        yaw = rng.uniform(0, 2 * np.pi)
        table = np.array([0, 0, -0.5 * TABLE_SIZE[2], np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)])
        self.poses = np.concatenate([table[None], poses])
        # Drawn last: neighbours do not change how the rest of the scene looks.
        self.looks += [object_look(rng) for _ in objects[1:]]


def _toward_lamp(rng: np.random.Generator) -> Floats:
    # One height for all scenes of a call; each scene turns under the lamp, so azimuths differ.
    elevation = np.radians(rng.uniform(40.0, 65.0))
    return np.array([np.cos(elevation), 0.0, np.sin(elevation)])


def _key(objects: Sequence[ObjectModel]) -> tuple[object, ...]:
    return tuple(obj.content for obj in objects)


def _solids(objects: Sequence[ObjectModel]) -> list[Solid | Box]:
    return [Box(TABLE_SIZE), *(Solid(obj.vertices, obj.faces, obj.corner_normals) for obj in objects)]


def _kept(key: tuple[object, ...], solids: Callable[[], Sequence[Solid | Box]], worlds: int, device: str) -> Tracer:
    if key not in _stages:
        _stages[key] = Tracer(solids(), worlds, device)
    return _stages[key]
