"""Robots of episodes: a hand on an arm, whose base stands behind the object, or a flying hand."""

from dataclasses import replace
from typing import Final

import numpy as np

from graspd.service.model.errors import InputError
from graspd.service.model.transforms import IDENTITY_POSE, Floats, apply, compose, quat_from_axis_angle
from graspd.worker.episodes.episode import Robot
from graspd.worker.episodes.execution import parse_pose
from graspd.worker.episodes.reach import Arm, read_arm
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.model import HandModel

#: Distance of an arm's base from the scene's origin [m].
BEHIND_M: Final = 0.5
#: Thickness of the adapter between flange and hand [m].
ADAPTER_M: Final = 0.01


def read_robot(
    hand: HandModel,
    arm: str | None = None,
    *,
    mount: str | None = None,
    mount_pose: str | None = None,
    base: str | None = None,
) -> Robot:
    """Return a hand carried by a built-in arm or one from a file, or a flying hand if `arm` is None.
    `mount_pose` (default: `adapter_pose`) and `base` (default: `base_pose`) are poses as text. Raises InputError: there
    is no such arm or mount, a pose is none, or `mount`, `mount_pose` or `base` is given without an arm."""
    if arm is None:
        if mount or mount_pose or base:
            raise InputError("--mount, --mount-pose and --base need an arm: --arm ur10e, franka or ARM.urdf")
        return Robot(hand)
    found = read_arm(arm, mount, adapter_pose(hand) if mount_pose is None else parse_pose(mount_pose, "--mount-pose"))
    found = carry_mounting(found, hand)
    return Robot(hand, found, base_pose(found) if base is None else parse_pose(base, "--base"))


def _rest_poses(mounting: HandModel) -> Floats:
    return body_poses(mounting, IDENTITY_POSE, mounting.expand(mounting.preshape))[0]


def adapter_pose(hand: HandModel) -> Floats:
    """Return the pose (7,) of the hand's root link in the flange's frame; its z axis leaves the arm.
    z is the palm's approach direction; with a forearm, z is the direction from its far end to the palm. The rear of the
    palm or forearm is `ADAPTER_M` before the flange, centred."""
    if hand.mounting is None:
        palm = [p.vertices for p in hand.pieces if p.body == 0] or [hand.palm.centre[None]]
        out, corners = hand.palm.approach, np.concatenate(palm)
    else:
        poses = _rest_poses(hand.mounting)
        corners = np.concatenate([apply(poses[p.body], p.vertices) for p in hand.mounting.pieces])
        out = -corners.mean(axis=0) / np.linalg.norm(corners.mean(axis=0))
    turn = rotation_between(out, np.array([0.0, 0.0, 1.0]))
    turned = apply(np.array([0, 0, 0, *turn]), corners)
    low, high = turned.min(axis=0), turned.max(axis=0)
    return np.array([*-0.5 * (low + high)[:2], ADAPTER_M - low[2], *turn])


def rotation_between(a: Floats, b: Floats) -> Floats:
    """Return the quaternion (4,) of the smallest rotation from unit vector `a` (3,) to `b` (3,)."""
    half = np.array([1.0 + a @ b, *np.cross(a, b)])
    if half[0] < 1e-9:
        half = np.array([0.0, *np.cross(a, np.eye(3)[np.argmin(np.abs(a))])])
    return half / np.linalg.norm(half)


def carry_mounting(arm: Arm, hand: HandModel) -> Arm:
    """Return the arm with the hand's forearm, wrist at rest, as a part of the body of the mount."""
    if hand.mounting is None:
        return arm
    poses = compose(compose(arm.mount_pose, arm.hand_pose), _rest_poses(hand.mounting))
    pieces = list(arm.model.pieces)
    for piece in hand.mounting.pieces:
        pose, vertices = compose(poses[piece.body], piece.pose), apply(poses[piece.body], piece.vertices)
        pieces.append(replace(piece, body=arm.mount_body, pose=pose, vertices=vertices))
    masses = np.array(arm.model.masses)
    masses[arm.mount_body] += hand.mounting.masses[1:].sum()  # body 0 is the hand's root
    return replace(arm, model=replace(arm.model, pieces=tuple(pieces), masses=masses))


def base_pose(arm: Arm) -> Floats:
    """Return the pose (7,) of an arm's root link on the table, `BEHIND_M` from the origin along -x.
    The direction from the base to the flange at home, or its x axis if the flange is above it, points along x."""
    poses = body_poses(arm.model, IDENTITY_POSE, arm.model.expand(arm.home))[0]
    x, y = compose(poses[arm.mount_body], arm.mount_pose)[:2]
    yaw = -np.arctan2(y, x) if np.hypot(x, y) > 0.01 else 0.0
    return np.array([-BEHIND_M, 0.0, 0.0, *quat_from_axis_angle(np.array([0.0, 0.0, 1.0]), np.array(yaw))])
