"""Executable grasps: six postures each, a tool frame of the user's choice, and the timed trajectory.

Each motion starts and ends at rest (minimum jerk, Flash and Hogan 1985). After the share u of its time it has covered
the share 10 u^3 - 15 u^4 + 6 u^5 of its path. The steepest slope of this polynomial is 15/8."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.errors import InputError
from graspd.service.model.transforms import IDENTITY_POSE, Floats, compose, slerp
from graspd.worker.grasps import GraspSet, Posture
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.model import HandModel, JointType
from graspd.worker.objects.model import ObjectModel
from graspd.worker.scenes.trajectory import plan_free_trajectory
from graspd.worker.simulation.environment import STANDOFF_M, PlacedGrasps

#: Postures of a grasp in order. The open hand moves from `standoff` to `arrival`, takes the shape of `pregrasp`, closes
#: to `grasp`, is commanded to `squeeze`, and rises to `lift`.
POSTURES: Final = ("standoff", "arrival", "pregrasp", "grasp", "squeeze", "lift")
PHASES: Final = ("approach", "shape", "close", "squeeze", "lift")  # motions between consecutive postures


@dataclass(frozen=True)
class ToolFrame:
    """A frame fixed to the hand's root link; robots are commanded by the pose of this frame."""

    name: str
    pose: Floats  # (7,) in the frame of the root link


@dataclass(frozen=True)
class Executions:
    """N grasps of one hand on one object with all their postures.
    Poses are in the frame named `frame`: the object's own, or the scene's (z up) for grasps planned in a scene."""

    hand: HandModel
    obj: ObjectModel
    tool: ToolFrame
    frame: str
    rows: NDArray[np.intp]  # (N,) row of each grasp in its shard
    object_pose: Floats  # (N, 7) poses of the object at rest
    postures: dict[str, Posture]
    """N postures for each name in `POSTURES`; hand poses are those of the root link."""
    placed: PlacedGrasps | None  # scene of each grasp, if there are scenes
    quality: dict[str, NDArray[Any]]  # (N,) verdicts and metrics: valid, success, epsilon

    def __len__(self) -> int:
        return len(self.rows)

    def tool_pose(self, posture: str) -> Floats:
        """Return (N, 7) poses of the tool frame in a posture of `POSTURES`."""
        return compose(self.postures[posture].hand_pose, self.tool.pose)

    @property
    def lifted_object_pose(self) -> Floats:
        """(N, 7) object pose after the lift, fixed in the hand."""
        pose = np.array(self.object_pose, float)
        pose[:, :3] += self.postures["lift"].hand_pose[:, :3] - self.postures["squeeze"].hand_pose[:, :3]
        return pose

    def take(self, rows: NDArray[np.intp]) -> Executions:
        """Return some of the grasps, in the order of `rows`."""
        return replace(
            self,
            rows=self.rows[rows],
            object_pose=self.object_pose[rows],
            postures={name: part.take(rows) for name, part in self.postures.items()},
            placed=None if self.placed is None else self.placed.take(rows),
            quality={name: values[rows] for name, values in self.quality.items()},
        )


def build_executions(
    hand: HandModel,
    obj: ObjectModel,
    grasps: GraspSet,
    *,
    rows: NDArray[np.intp],
    placed: PlacedGrasps | None,
    tool: ToolFrame,
    quality: dict[str, NDArray[Any]],
) -> Executions:
    """Return grasps with their trajectories in scenes, or with straight approaches that are planned here.
    Grasps whose approach is not free are omitted. Raises InputError: this holds for all grasps."""
    frame, at = "object", np.tile(IDENTITY_POSE, (len(grasps), 1))
    free = np.ones(len(grasps), bool)
    if placed is None or grasps.approach is None or grasps.coming is None or grasps.lift is None:
        way = plan_free_trajectory(hand, obj, grasps)
        free, coming = ~way.touching, way.open
        ends, lift = (way.approach[:, 0], way.approach[:, -1]), way.lift
    else:
        frame, at = "scene", np.asarray(placed.object_pose, float)[placed.index]
        coming, ends, lift = grasps.coming, (grasps.approach[:, 0], grasps.approach[:, -1]), grasps.lift
    parts = [*(Posture(end, coming) for end in ends), grasps.pregrasp, grasps.grasp, grasps.squeeze, lift]
    placed_parts = (Posture(compose(at, part.hand_pose), part.joint_positions) for part in parts)
    postures = dict(zip(POSTURES, placed_parts, strict=True))
    whole = Executions(hand, obj, tool, frame, np.asarray(rows, np.intp), at, postures, placed, dict(quality))
    if len(grasps) and not free.any():
        raise InputError(f"none of {len(grasps)} grasps has a free straight approach of {100 * STANDOFF_M:.0f} cm")
    return whole.take(np.flatnonzero(free))


def posed_bodies(found: Executions, posture: str, row: int) -> Floats:
    """Return (L, 7) poses of the hand's bodies in one posture of one grasp."""
    part = found.postures[posture]
    return np.asarray(body_poses(found.hand, part.hand_pose[row], part.joint_positions[row])[0])


_SLACK = 1e-2  # tolerance of a quaternion's length around 1
_EXACT = 1e-12  # error of a unit quaternion by rounding; such a pose is unchanged


def parse_pose(text: str, what: str) -> Floats:
    """Parse a pose (7,) `x y z qw qx qy qz` with x y z in metres, separated by spaces or commas.
    Raises InputError, with the option `what`: the text is no pose."""
    try:
        values = np.array([float(part) for part in text[:400].replace(",", " ").split()])
    except ValueError:
        values = np.zeros(0)
    if values.shape != (7,) or not np.isfinite(values).all():
        raise InputError(f"{what} {text[:80]!r} is no pose; give seven numbers: x y z qw qx qy qz")
    length = float(np.linalg.norm(values[3:]))
    if abs(length - 1.0) > _SLACK:
        raise InputError(f"{what}: the quaternion qw qx qy qz has length {length:.3g}; it must be 1")
    if abs(length - 1.0) > _EXACT:
        values[3:] /= length
    return values


def tool_frame(text: str | None, root_link: str, links: Mapping[str, tuple[int, Floats]]) -> ToolFrame:
    """Return the tool frame `text`; by default, the frame of the root link.
    `text` is a link that no finger moves, or a pose in the root link's frame. `links` has body and pose of each link,
    see `HandDescription`. Raises InputError: `text` is neither."""
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


#: Velocity of a joint without a limit in its description [rad/s, m/s].
ASSUMED_RAD_S: Final = 1.0
ASSUMED_M_S: Final = 0.05
#: Velocity limit of the hand as a whole [m/s, rad/s].
HAND_M_S: Final = 0.25
HAND_RAD_S: Final = 1.0
#: Shortest duration of a motion, and largest time between points [s].
SHORTEST_S: Final = 0.4
STEP_S: Final = 0.05
_STEEPEST: Final = 15 / 8


@dataclass(frozen=True)
class VelocityLimits:
    """Velocity limits of joints."""

    velocity: Floats  # (J,) [rad/s or m/s]
    assumed: tuple[str, ...]  # joints without a stated limit


@dataclass(frozen=True)
class Path:
    """A motion of hand and joints without times: M points at equal shares of the path."""

    phase: str
    hand_pose: Floats  # (M, 7)
    joints: Floats  # (M, J)


@dataclass(frozen=True)
class RobotTrajectory:
    """K points of all motions of a grasp, with times."""

    joint_names: tuple[str, ...]
    phase: tuple[str, ...]  # (K,) motion to which each point belongs
    time: Floats  # (K,) times since the start [s]
    hand_pose: Floats  # (K, 7) poses of the root link
    joints: Floats  # (K, J)
    velocity: Floats  # (K, J) joint velocities, by differences


def velocity_limits(hand: HandModel) -> VelocityLimits:
    """Return velocity limits of a hand's joints: the description's, else `ASSUMED_RAD_S` or `ASSUMED_M_S`."""
    body = hand.joint_body
    stated = np.abs(hand.multiplier[body]) * hand.velocity[hand.dof[body]]
    default = np.where(hand.joint_type[body] == JointType.REVOLUTE, ASSUMED_RAD_S, ASSUMED_M_S)
    silent = tuple(name for name, known in zip(hand.joint_names, stated, strict=True) if known <= 0)
    return VelocityLimits(np.where(stated > 0, stated, default), silent)


def straight_paths(found: Executions, row: int, points: int = 2) -> list[Path]:
    """Return the motions of one grasp; root pose and joints move evenly between postures."""
    paths = []
    for phase, start, end in zip(PHASES, POSTURES[:-1], POSTURES[1:], strict=True):
        a, b = found.postures[start], found.postures[end]
        shares = np.linspace(0.0, 1.0, points)[:, None]
        joints = (1 - shares) * a.joint_positions[row] + shares * b.joint_positions[row]
        paths.append(Path(phase, _poses(a.hand_pose[row], b.hand_pose[row], shares[:, 0]), joints))
    return paths


def time_motions(paths: Sequence[Path], names: Sequence[str], velocity: Floats, *, speed: float) -> RobotTrajectory:
    """Return the timed sequence of motions, each from rest to rest.
    `velocity` (J,) has the joints' limits [rad/s or m/s]; `speed`, in (0, 1], scales these and the hand's limits."""
    phase, time, pose, joints = [paths[0].phase], [0.0], [paths[0].hand_pose[:1]], [paths[0].joints[:1]]
    for path in paths:
        seconds = max(SHORTEST_S, _STEEPEST * _shortest_duration(path, velocity) / speed)
        count = math.ceil(seconds / STEP_S)
        u = np.arange(1, count + 1) / count
        share = minimum_jerk(u)
        phase += [path.phase] * count
        begun = time[-1]
        time += (begun + seconds * u).tolist()
        at = share * (len(path.joints) - 1)
        left = np.minimum(at.astype(int), len(path.joints) - 2)
        rest = at - left
        joints.append((1 - rest)[:, None] * path.joints[left] + rest[:, None] * path.joints[left + 1])
        pose += [
            _poses(path.hand_pose[k], path.hand_pose[k + 1], np.array([r])) for k, r in zip(left, rest, strict=True)
        ]
    found, when = np.concatenate(joints), np.array(time)
    rate = np.gradient(found, when, axis=0)
    rate[[0, -1]] = 0.0
    return RobotTrajectory(tuple(names), tuple(phase), when, np.concatenate(pose), found, rate)


def minimum_jerk(time: Floats) -> Floats:
    """Return the share of the path after a share of the time."""
    return time**3 * (10 - 15 * time + 6 * time**2)


def _shortest_duration(path: Path, velocity: Floats) -> float:
    """Return the shortest duration of the motion at a constant rate within its limits [s]."""
    pieces = len(path.joints) - 1
    joints = np.abs(np.diff(path.joints, axis=0)) / velocity
    way = np.linalg.norm(np.diff(path.hand_pose[:, :3], axis=0), axis=1) / HAND_M_S
    cosine = np.abs((path.hand_pose[1:, 3:] * path.hand_pose[:-1, 3:]).sum(axis=1))
    turn = 2 * np.arccos(np.minimum(cosine, 1.0)) / HAND_RAD_S
    return pieces * float(max(joints.max(initial=0.0), way.max(), turn.max()))


def _poses(start: Floats, end: Floats, shares: NDArray[np.float64]) -> Floats:
    """Return (M, 7) poses between two poses, at shares (M,) of the path."""
    place = (1 - shares)[:, None] * start[:3] + shares[:, None] * end[:3]
    turn = np.array([slerp(start[3:], end[3:], float(share)) for share in shares])
    return np.concatenate([place, turn], axis=1)
