"""Sheets and animations of a base shard's grasps: at the grasp, in the scene, or along the trajectory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from graspd.service.model.scene_spec import scene_supports
from graspd.service.model.transforms import compose, invert
from graspd.service.readers.trajectories import Waypoint, planned_scene_of, trajectory_of, wrist_angles
from graspd.service.store.shards import Shard
from graspd.worker.episodes import execution
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.files.provenance import neighbours_of_shard, scenes_of_shard
from graspd.worker.grasps import GraspSet, Posture
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.rendering.pictures import SAMPLES, THREE_SIDES, grasp_pictures
from graspd.worker.rendering.sheets import caption_entries, contact_sheet, label_page, three_sides_sheet
from graspd.worker.rendering.trajectory_pictures import (
    FREE_STRIP,
    STRIP,
    PictureScenes,
    animation_kind,
    encode_animation,
    trajectory_pictures,
)

Kind = Literal["one side", "three sides", "trajectory"]
#: Edge of a grasp's picture [px], and rays per pixel.
_LARGE: Final = (300, SAMPLES)
LOOKS: Final[dict[Kind, tuple[int, int]]] = {"one side": _LARGE, "three sides": (160, 8), "trajectory": _LARGE}


@dataclass(frozen=True)
class GraspSheet:
    """Contact sheet of some rows of a shard."""

    shard: Shard
    hand: HandModel
    obj: ObjectModel
    rows: NDArray[np.intp]
    kind: Kind
    run: ExecutionContext
    edge: int | None = None

    @property
    def size(self) -> tuple[int, int]:
        edge = self.edge or LOOKS[self.kind][0]
        return edge, edge

    @property
    def scene(self) -> str:
        spec = planned_scene_of(self.shard)
        return "" if spec is None else spec.kind

    def png(self, *, subtitle: str) -> bytes:
        said = self.shard.attributes
        title = f"{said.get('hand', self.hand.name)} on {said.get('object', self.obj.name)}"
        title += f", {self.scene}" if self.scene else ""
        captions = caption_entries(self.shard.arrays, self.rows)
        if self.kind == "trajectory":
            names, drawn = self._strip_pictures()
            below = [[f"{k + 1}   " + ",  ".join(" ".join(pair) for pair in one)] for k, one in enumerate(captions)]
            cells = [[Image.fromarray(picture) for picture in strip] for strip in drawn]
            return label_page(cells, names, below, title=title, subtitle=subtitle)
        drawn = self._grasp_pictures()
        if self.kind == "three sides":
            return three_sides_sheet(drawn, captions, title=title, subtitle=subtitle)
        return contact_sheet(drawn[:, 0], captions, title=title, subtitle=subtitle)

    def _strip_pictures(self) -> tuple[tuple[str, ...], NDArray[np.uint8]]:
        """Return the names of the postures, and their pictures (N, F, H, W, 3)."""
        names = (
            STRIP if any(point.name == "lift" for point in trajectory_of(self.shard, int(self.rows[0]))) else FREE_STRIP
        )
        return names, self._render(names, 1)[:, 0]

    def _grasp_pictures(self) -> NDArray[np.uint8]:
        """Return pictures at the grasp (N, A, H, W, 3)."""
        sides = 3 if self.kind == "three sides" else 1
        if self.scene:
            return self._render(("grasp",), sides)[:, :, 0]
        shown, samples = Posture.from_columns(self.shard.arrays).take(self.rows), LOOKS[self.kind][1]
        at = (shown.hand_pose, shown.joint_positions, self.size, THREE_SIDES[:sides])
        return grasp_pictures(self.hand, self.obj, *at, run=self.run, samples=samples)

    def _render(self, names: Sequence[str], sides: int) -> NDArray[np.uint8]:
        """Return pictures (N, A, F, H, W, 3) of the named points of the trajectories."""
        named = [{point.name: point for point in reversed(trajectory_of(self.shard, int(row)))} for row in self.rows]
        frames, around = [[points[name] for name in names] for points in named], surroundings_of(self.shard, self.rows)
        seen: dict[str, Any] = {"sides": sides, "run": self.run, "samples": LOOKS[self.kind][1]}
        return trajectory_pictures(self.hand, self.obj, frames, around, self.size, **seen)


def surroundings_of(shard: Shard, rows: NDArray[np.intp]) -> PictureScenes:
    """Return the surroundings of grasps of a base shard: the scenes in which they were planned, or none."""
    if (spec := planned_scene_of(shard)) is None:
        return PictureScenes()
    poses = np.asarray(shard["scene/object_pose"], float)
    index = np.asarray(shard["grasp/scene_index"], np.intp)[rows]
    return PictureScenes(scene_supports(spec), poses, index, neighbours_of_shard(shard, []), wrist_angles(shard, rows))


#: Width of the animation [px], and its height as a share of the width.
WIDTH: Final = 480
HIGH: Final = 0.75

#: Rays per pixel of an animation.
FILM_SAMPLES: Final = 24
#: Used share of the velocity limits of joints and hand.
SPEED: Final = 0.5
#: Times [s] for which the open hand is shown before its motion, and the lifted object before a repetition.
BEFORE_S: Final = 0.4
AFTER_S: Final = 1.4


@dataclass(frozen=True)
class GraspAnimation:
    """Animation of the trajectories of grasps of a shard, one after the other."""

    shard: Shard
    hand: HandModel
    obj: ObjectModel
    rows: NDArray[np.intp]
    run: ExecutionContext
    width: int | None = None

    def encode(self, suffix: str) -> bytes:
        """Return the animation as GIF, WebP or animated PNG."""
        animation_kind(suffix)
        pictures: list[NDArray[np.uint8]] = []
        seconds: list[float] = []
        for row in self.rows:
            found = self._execute(row)
            limits, names = execution.velocity_limits(found.hand), found.hand.joint_names
            trajectory = execution.time_motions(execution.straight_paths(found, 0), names, limits.velocity, speed=SPEED)
            pictures.append(self._render(row, waypoints(found, trajectory)))
            shown = [execution.STEP_S, *np.diff(trajectory.time).tolist()]
            shown[0] += BEFORE_S
            shown[-1] += AFTER_S
            seconds += shown
        return encode_animation(np.concatenate(pictures), seconds, suffix)

    def _execute(self, row: np.intp) -> execution.Executions:
        one, placed = np.array([row]), scenes_of_shard(self.shard)
        grasps = GraspSet.from_columns(self.shard.arrays).take(one)
        placed = None if placed is None else placed.take(one)
        tool = execution.tool_frame(None, self.hand.root_link, {})
        return execution.build_executions(self.hand, self.obj, grasps, rows=one, placed=placed, tool=tool, quality={})

    def _render(self, row: np.intp, trajectory: Sequence[Waypoint]) -> NDArray[np.uint8]:
        width = self.width or WIDTH
        around = surroundings_of(self.shard, np.array([row]))
        size = (width, round(HIGH * width))
        (sides,) = trajectory_pictures(
            self.hand, self.obj, [trajectory], around, size, whole=True, run=self.run, samples=FILM_SAMPLES
        )
        return np.asarray(sides[0])


def waypoints(found: execution.Executions, trajectory: execution.RobotTrajectory) -> list[Waypoint]:
    """Return the points of the first grasp's trajectory, in the frame of the object at rest."""
    poses = compose(invert(found.object_pose[0]), trajectory.hand_pose)
    held = trajectory.phase.index("lift")
    carried = np.where(np.arange(len(poses))[:, None] < held, 0.0, poses[:, :3] - poses[held - 1, :3])
    closed = trajectory.phase.index("squeeze") - 1
    names = ["grasp" if k == closed else "" for k in range(len(poses))]
    return [Waypoint(*row) for row in zip(names, poses, trajectory.joints, carried, strict=True)]
