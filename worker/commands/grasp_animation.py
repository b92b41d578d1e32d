"""A film of grasps of a base shard as a robot carries them out: the hand comes, closes and lifts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from service.model.transforms import compose, invert
from service.readers.ways import Waypoint
from service.store.shards import Shard
from worker.commands.grasp_sheet import around_of
from worker.files.of_shard import placed_of_shard
from worker.grasps import GraspSet
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel
from worker.rendering.pages.animation import animation, animation_kind
from worker.rendering.pages.way_pictures import way_pictures
from worker.robots.execution import Executions, executions
from worker.robots.frames import tool_frame
from worker.robots.timing import STEP_S, Trajectory, hand_limits, straight_paths, timed
from worker.run import Run

#: Width of the film [px], and its height as a share of that.
WIDTH: Final = 480
HIGH: Final = 0.75
#: Rays a pixel: shadows that move show what is coarse in them.
SAMPLES: Final = 24
#: Share of the velocity limits of joints and hand that is used.
SPEED: Final = 0.5
#: The open hand is shown for so long before it sets out, and the lifted object before all begins anew [s].
BEFORE_S: Final = 0.4
AFTER_S: Final = 1.4


@dataclass(frozen=True)
class GraspAnimation:
    """Grasps of a shard on their way, one after the other."""

    shard: Shard
    hand: HandModel
    obj: ObjectModel
    rows: NDArray[np.intp]
    run: Run
    width: int | None = None
    """[px]; None: `WIDTH`."""
    samples: int = SAMPLES

    def file(self, suffix: str) -> bytes:
        """The film as GIF, WebP or animated PNG.

        Raises:
            InputError: another suffix, or a grasp has no way that is free of the object.
        """
        animation_kind(suffix)
        pictures: list[NDArray[np.uint8]] = []
        seconds: list[float] = []
        for row in self.rows:
            found = self._executed(row)
            way = _timed(found)
            pictures.append(self._drawn(row, waypoints(found, way)))
            seconds += _shown(way)
        return animation(np.concatenate(pictures), seconds, suffix)

    def _executed(self, row: np.intp) -> Executions:
        one, placed = np.array([row]), placed_of_shard(self.shard)
        grasps = GraspSet.from_columns(self.shard.arrays).take(one)
        return executions(
            self.hand,
            self.obj,
            grasps,
            rows=one,
            placed=None if placed is None else placed.take(one),
            tool=tool_frame(None, self.hand.root_link, {}),
            quality={},
        )

    def _drawn(self, row: np.intp, way: Sequence[Waypoint]) -> NDArray[np.uint8]:
        width = self.width or WIDTH
        around = around_of(self.shard, np.array([row]))
        size = (width, round(HIGH * width))
        (sides,) = way_pictures(
            self.hand, self.obj, [way], around, size, whole=True, run=self.run, samples=self.samples
        )
        return np.asarray(sides[0])


def waypoints(found: Executions, way: Trajectory) -> list[Waypoint]:
    """The points of the trajectory of the first grasp, in the frame of the object at rest."""
    rest = found.object_pose[0]
    poses = compose(invert(rest), way.hand_pose)
    held = way.phase.index("lift")
    carried = np.where(np.arange(len(poses))[:, None] < held, 0.0, poses[:, :3] - poses[held - 1, :3])
    closed = way.phase.index("squeeze") - 1
    return [Waypoint("grasp" if k == closed else "", pose, way.joints[k], carried[k]) for k, pose in enumerate(poses)]


def _timed(found: Executions) -> Trajectory:
    limits = hand_limits(found.hand)
    return timed(straight_paths(found, 0), found.hand.joint_names, limits.velocity, speed=SPEED)


def _shown(way: Trajectory) -> list[float]:
    seconds = [STEP_S, *np.diff(way.time).tolist()]
    seconds[0] += BEFORE_S
    seconds[-1] += AFTER_S
    return seconds
