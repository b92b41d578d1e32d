"""Grasps ready to be carried out: six postures each, in one frame that the user names, and the trajectory between
them."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from service.model.errors import InputError
from service.model.transforms import IDENTITY_POSE, Floats, compose
from worker.grasps import GraspSet, Posture
from worker.hands.kinematics import body_poses
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel
from worker.scenes.way import plan_free_way
from worker.simulation.surroundings import STANDOFF_M, Placed

#: Postures of a grasp in their order. The hand comes from `standoff` to `arrival` with open fingers, takes the shape of
#: `pregrasp`, closes to `grasp`, is commanded to `squeeze`, and rises to `lift`.
POSTURES: Final = ("standoff", "arrival", "pregrasp", "grasp", "squeeze", "lift")

#: Motions from one posture to the next.
PHASES: Final = ("approach", "shape", "close", "squeeze", "lift")


@dataclass(frozen=True)
class ToolFrame:
    """A frame fixed to the hand's root link: what is steered to a pose."""

    name: str
    pose: Floats
    """(7,) in the frame of the root link."""


@dataclass(frozen=True)
class Executions:
    """N grasps of one hand on one object with all their postures.

    Poses stand in the frame named `frame`: the object's own, or the scene's (z up) where they were planned in one.
    """

    hand: HandModel
    obj: ObjectModel
    tool: ToolFrame
    frame: str
    rows: NDArray[np.intp]
    """(N,) row of each grasp in its shard."""
    object_pose: Floats
    """(N, 7) the object at rest."""
    postures: dict[str, Posture]
    """The N postures of each of `POSTURES`; hand poses are those of the root link."""
    placed: Placed | None
    """The scene of each grasp, if they have one."""
    quality: dict[str, NDArray[Any]]
    """(N,) verdicts and metrics: valid, success, epsilon."""

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def scene_index(self) -> NDArray[np.intp]:
        """(N,) number of each grasp's scene; 0 around a free object."""
        return np.zeros(len(self), np.intp) if self.placed is None else self.placed.index

    def tool_pose(self, posture: str) -> Floats:
        """(N, 7) of the tool frame in a posture."""
        return compose(self.postures[posture].hand_pose, self.tool.pose)

    @property
    def approach(self) -> Floats:
        """(N, 3) unit vectors along which the hand comes."""
        return self._direction("standoff", "arrival")

    @property
    def retreat(self) -> Floats:
        """(N, 3) unit vectors along which the hand leaves with the object."""
        return self._direction("squeeze", "lift")

    def _direction(self, start: str, end: str) -> Floats:
        way = self.postures[end].hand_pose[:, :3] - self.postures[start].hand_pose[:, :3]
        return np.asarray(way / np.linalg.norm(way, axis=1, keepdims=True))

    @property
    def lifted_object_pose(self) -> Floats:
        """(N, 7) the object after the lift, held as it was grasped."""
        pose = np.array(self.object_pose, float)
        pose[:, :3] += self.postures["lift"].hand_pose[:, :3] - self.postures["squeeze"].hand_pose[:, :3]
        return pose

    def take(self, rows: NDArray[np.intp]) -> Executions:
        """Some of the grasps, in the order of `rows`."""
        return replace(
            self,
            rows=self.rows[rows],
            object_pose=self.object_pose[rows],
            postures={name: part.take(rows) for name, part in self.postures.items()},
            placed=None if self.placed is None else self.placed.take(rows),
            quality={name: values[rows] for name, values in self.quality.items()},
        )


def executions(
    hand: HandModel,
    obj: ObjectModel,
    grasps: GraspSet,
    *,
    rows: NDArray[np.intp],
    placed: Placed | None,
    tool: ToolFrame,
    quality: dict[str, NDArray[Any]],
) -> Executions:
    """Grasps with their ways: those they were planned with in their scene, or around a free object planned here.

    Args:
        hand: the hand.
        obj: the object.
        grasps: N grasps.
        rows: (N,) their rows in the shard.
        placed: the scene of each, None around a free object.
        tool: the tool frame.
        quality: (N,) columns that are handed on.

    Returns:
        Those that have a way. Around a free object it may be that no straight retreat of 10 cm is free of it.

    Raises:
        InputError: none has a way.
    """
    frame, at = "object", np.tile(IDENTITY_POSE, (len(grasps), 1))
    free = np.ones(len(grasps), bool)
    if placed is None or grasps.approach is None or grasps.coming is None or grasps.lift is None:
        way = plan_free_way(hand, obj, grasps)
        free, coming = ~way.touching, way.open
        ends, lift = (way.approach[:, 0], way.approach[:, -1]), way.lift
    else:
        frame, at = "scene", np.asarray(placed.object_pose, float)[placed.index]
        coming, ends, lift = grasps.coming, (grasps.approach[:, 0], grasps.approach[:, -1]), grasps.lift
    found = {
        "standoff": Posture(ends[0], coming),
        "arrival": Posture(ends[1], coming),
        "pregrasp": grasps.pregrasp,
        "grasp": grasps.grasp,
        "squeeze": grasps.squeeze,
        "lift": lift,
    }
    postures = {name: Posture(compose(at, part.hand_pose), part.joint_positions) for name, part in found.items()}
    whole = Executions(hand, obj, tool, frame, np.asarray(rows, np.intp), at, postures, placed, dict(quality))
    if not free.any():
        raise InputError(
            f"none of {len(grasps)} grasps can be reached along a straight way of {100 * STANDOFF_M:.0f} cm that is "
            "free of the object"
        )
    return whole.take(np.flatnonzero(free))


def posed_bodies(found: Executions, posture: str, row: int) -> Floats:
    """(L, 7) poses of the hand's bodies in one posture of one grasp."""
    part = found.postures[posture]
    return np.asarray(body_poses(found.hand, part.hand_pose[row], part.joint_positions[row])[0])


#: How far a quaternion may be from length 1 before it is taken for a mistake.
_SLACK = 1e-2


def parse_pose(text: str, what: str) -> Floats:
    """(7,) from `x y z qw qx qy qz`, separated by spaces or commas [m, 1].

    Raises:
        InputError: not seven finite numbers, or no unit quaternion.
    """
    try:
        values = np.array([float(part) for part in text[:400].replace(",", " ").split()])
    except ValueError:
        values = np.zeros(0)
    if values.shape != (7,) or not np.isfinite(values).all():
        raise InputError(f"{what} {text[:80]!r} is no pose; give seven numbers: x y z qw qx qy qz")
    length = float(np.linalg.norm(values[3:]))
    if abs(length - 1.0) > _SLACK:
        raise InputError(f"{what}: the quaternion qw qx qy qz has length {length:.3g}; it must be 1")
    values[3:] /= length
    return values


def tool_frame(text: str | None, root_link: str, links: Mapping[str, tuple[int, Floats]]) -> ToolFrame:
    """The tool frame that a user names: a link that does not move with a finger, or a pose in the root link's frame.

    Args:
        text: a link's name or seven numbers; None: the root link itself.
        root_link: name of the hand's root link.
        links: body and pose of each link, see `Description`.

    Raises:
        InputError: there is no such link, it moves with a finger, or the numbers are no pose.
    """
    if not text or text == root_link:
        return ToolFrame(root_link, IDENTITY_POSE.copy())
    if text in links:
        body, pose = links[text]
        if body:
            raise InputError(f"the link {text!r} moves with a finger; a tool frame is fixed to {root_link!r}")
        return ToolFrame(text, np.array(pose, float))
    if _is_pose(text):
        return ToolFrame("tool", parse_pose(text, "--tool-frame"))
    still = [name for name, (body, _) in links.items() if body == 0]
    near = difflib.get_close_matches(text, links, 1)
    hint = f"; did you mean {near[0]!r}?" if near else ";"
    raise InputError(
        f"the hand has no link {text[:80]!r}{hint} fixed links: {', '.join(still[:8])}; or give a "
        "pose x y z qw qx qy qz"
    )


def _is_pose(text: str) -> bool:
    first = text.replace(",", " ").split()[:1]
    try:
        return bool(first) and np.isfinite(float(first[0]))
    except ValueError:
        return False
