"""Times for the motions of a grasp, within the velocity limits of joints and hand.

Each motion starts and ends at rest: its share s of the way follows 10 u^3 - 15 u^4 + 6 u^5 of the share u of its time
(minimum jerk, Flash and Hogan 1985), whose steepest slope is 15/8.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from service.model.transforms import Floats, slerp
from worker.hands.model import HandModel, JointType
from worker.robots.execution import PHASES, POSTURES, Executions

#: Velocity of a joint whose description states none [rad/s, m/s].
ASSUMED_RAD_S: Final = 1.0
ASSUMED_M_S: Final = 0.05
#: The hand as a whole moves and turns no faster [m/s, rad/s].
HAND_M_S: Final = 0.25
HAND_RAD_S: Final = 1.0
#: Shortest motion, and time between points [s].
SHORTEST_S: Final = 0.4
STEP_S: Final = 0.05
_STEEPEST: Final = 15 / 8


@dataclass(frozen=True)
class Limits:
    """Velocity limits of joints."""

    velocity: Floats
    """(J,) [rad/s or m/s]"""
    assumed: tuple[str, ...]
    """Joints whose limit nobody states."""


@dataclass(frozen=True)
class Path:
    """A motion of hand and joints without times: M points at even shares of the way."""

    phase: str
    hand_pose: Floats
    """(M, 7)"""
    joints: Floats
    """(M, J)"""


@dataclass(frozen=True)
class Trajectory:
    """K points of all motions of a grasp, in time."""

    joint_names: tuple[str, ...]
    phase: tuple[str, ...]
    """(K,) the motion that each point belongs to; the first point begins the first one."""
    time: Floats
    """(K,) since the beginning [s]."""
    hand_pose: Floats
    """(K, 7) of the root link."""
    joints: Floats
    """(K, J)"""
    velocity: Floats
    """(K, J) of the joints, by differences."""


def hand_limits(hand: HandModel) -> Limits:
    """Velocity limits of a hand's joints: those of its description, else `ASSUMED_RAD_S` or `ASSUMED_M_S`."""
    body = hand.joint_body
    stated = np.abs(hand.multiplier[body]) * hand.velocity[hand.dof[body]]
    default = np.where(hand.joint_type[body] == JointType.REVOLUTE, ASSUMED_RAD_S, ASSUMED_M_S)
    silent = tuple(name for name, known in zip(hand.joint_names, stated, strict=True) if known <= 0)
    return Limits(np.where(stated > 0, stated, default), silent)


def straight_paths(found: Executions, row: int, points: int = 2) -> list[Path]:
    """The motions of one grasp: root and joints evenly from posture to posture, the root's turn at an even rate."""
    paths = []
    for phase, start, end in zip(PHASES, POSTURES[:-1], POSTURES[1:], strict=True):
        a, b = found.postures[start], found.postures[end]
        shares = np.linspace(0.0, 1.0, points)[:, None]
        joints = (1 - shares) * a.joint_positions[row] + shares * b.joint_positions[row]
        paths.append(Path(phase, _poses(a.hand_pose[row], b.hand_pose[row], shares[:, 0]), joints))
    return paths


def timed(paths: Sequence[Path], names: Sequence[str], velocity: Floats, *, speed: float) -> Trajectory:
    """Motions one after the other, each at rest at both ends.

    Args:
        paths: the motions; each begins where the one before ends.
        names: (J,) names of the joints.
        velocity: (J,) limits [rad/s or m/s].
        speed: share of these limits, and of the hand's, that is used; above 0, at most 1.
    """
    phase, time, pose, joints = [paths[0].phase], [0.0], [paths[0].hand_pose[:1]], [paths[0].joints[:1]]
    for path in paths:
        seconds = max(SHORTEST_S, _STEEPEST * _slowness(path, velocity) / speed)
        count = math.ceil(seconds / STEP_S)
        u = np.arange(1, count + 1) / count
        share = u**3 * (10 - 15 * u + 6 * u**2)
        phase += [path.phase] * count
        begun = time[-1]
        time += (begun + seconds * u).tolist()
        at = share * (len(path.joints) - 1)
        left = np.minimum(at.astype(int), len(path.joints) - 2)
        rest = at - left
        joints.append((1 - rest)[:, None] * path.joints[left] + rest[:, None] * path.joints[left + 1])
        pose.append(
            np.array(
                [
                    _poses(path.hand_pose[k], path.hand_pose[k + 1], np.array([r]))[0]
                    for k, r in zip(left, rest, strict=True)
                ]
            )
        )
    found, when = np.concatenate(joints), np.array(time)
    rate = np.gradient(found, when, axis=0)
    rate[[0, -1]] = 0.0
    return Trajectory(tuple(names), tuple(phase), when, np.concatenate(pose), found, rate)


def _slowness(path: Path, velocity: Floats) -> float:
    """Seconds that the motion takes at its limits if its share of the way grows evenly."""
    pieces = len(path.joints) - 1
    joints = np.abs(np.diff(path.joints, axis=0)) / velocity
    way = np.linalg.norm(np.diff(path.hand_pose[:, :3], axis=0), axis=1) / HAND_M_S
    cosine = np.abs((path.hand_pose[1:, 3:] * path.hand_pose[:-1, 3:]).sum(axis=1))
    turn = 2 * np.arccos(np.minimum(cosine, 1.0)) / HAND_RAD_S
    return pieces * float(max(joints.max(initial=0.0), way.max(), turn.max()))


def _poses(start: Floats, end: Floats, shares: NDArray[np.float64]) -> Floats:
    """(M, 7) poses between two at shares (M,) of the way."""
    place = (1 - shares)[:, None] * start[:3] + shares[:, None] * end[:3]
    turn = np.array([slerp(start[3:], end[3:], float(share)) for share in shares])
    return np.concatenate([place, turn], axis=1)
