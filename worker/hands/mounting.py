"""Mounting of a hand: links above its root whose poses follow from a grasp, except for wrist angles.

The mounting is its own kinematic tree from the hand's root up the robot. The tree contains fixed joints, joints with
one value, and at most `MAX_WRIST_JOINTS` wrist joints: revolute, of limited range, near the root. The first other joint
belongs to an arm, whose poses a grasp does not determine."""

import math
from dataclasses import replace
from itertools import product
from typing import Final

import numpy as np

from graspd.service.model.transforms import IDENTITY_POSE, Floats, compose, invert
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.options import HandOptions
from graspd.worker.hands.robot import Joint, Mimic, Robot, joint_chain
from graspd.worker.hands.tree import LEAST_RANGE, Body, Tree, joint_motion

#: Limits of a wrist: number of joints, range of each [rad], and distance from the root along the joints [m]. The last
#: joint of an arm usually has a larger range.
MAX_WRIST_JOINTS: Final = 2
MAX_WRIST_RANGE: Final = math.pi
MAX_WRIST_M: Final = 0.1
#: Sampled angles of a wrist joint: shares of the range from its rest angle to either limit.
WRIST_SHARES: Final = (0.5, 1.0)


def mounting_tree(robot: Robot, root: str, options: HandOptions) -> Tree | None:
    """Build the tree of links above the root, in the root link's frame; None if no link has a shape."""
    bodies = [Body(root)]
    links: dict[str, tuple[int, Floats]] = {}
    pose, way = IDENTITY_POSE.copy(), 0.0
    for joint in reversed(joint_chain(robot, root)):
        if joint.parent in options.drop:
            break
        value = _fixed_value(joint, options)
        if value is None:
            if len(bodies) > MAX_WRIST_JOINTS or way > MAX_WRIST_M or not _is_wrist_joint(joint):
                break
            # Relative to the child, the parent turns in reverse about the same axis; then its offset follows.
            bodies.append(Body(joint.parent, len(bodies) - 1, replace(joint, axis=-joint.axis), pose))
            pose = invert(joint.origin)
        else:
            pose = compose(pose, invert(compose(joint.origin, joint_motion(joint, value))))
        way += float(np.linalg.norm(joint.origin[:3]))
        links |= {link: (len(bodies) - 1, at) for link, at in _rigid_link_poses(robot, joint, pose, options).items()}
    if not any(robot.links[link].shapes for link in links):
        return None
    wrist = [body.joint for body in bodies if body.joint is not None]
    lower, upper, velocity = np.array([(j.lower, j.upper, j.velocity) for j in wrist]).reshape(-1, 3).T
    drives = {joint.name: Mimic(joint.name, 1.0, 0.0) for joint in wrist}
    moving = tuple(drives)
    return Tree(tuple(bodies), links, drives, moving, moving, lower, upper, velocity, (), frozenset())


def _fixed_value(joint: Joint, options: HandOptions) -> float | None:
    """Return the value [rad or m] of a joint that does not move; None if it moves."""
    if joint.type == "fixed":
        return 0.0
    if joint.name in options.fix:
        return options.fix[joint.name]
    return joint.lower if joint.is_movable and joint.mimic is None and joint.upper - joint.lower < LEAST_RANGE else None


def _is_wrist_joint(joint: Joint) -> bool:
    limited = joint.is_movable and joint.type == "revolute" and joint.mimic is None
    return limited and joint.upper - joint.lower <= MAX_WRIST_RANGE


def _rigid_link_poses(robot: Robot, joint: Joint, pose: Floats, options: HandOptions) -> dict[str, Floats]:
    """Return the poses of a joint's parent (`pose`) and of links fixed to it, except the joint's child."""
    found, stack = {joint.parent: pose}, [joint.parent]
    while stack:
        at = stack.pop()
        for other in robot.joints.values():
            if other.parent == at and other.type == "fixed" and other.child not in (joint.child, *options.drop):
                found[other.child] = compose(found[at], other.origin)
                stack.append(other.child)
    return found


def wrist_positions(mounting: HandModel) -> Floats:
    """Return sampled angles (W, K) of the wrist's K joints, sorted by distance from the rest position."""
    angles = [
        [rest, *(rest + share * (end - rest) for share in WRIST_SHARES for end in (low, high) if end != rest)]
        for rest, low, high in zip(mounting.preshape, mounting.lower, mounting.upper, strict=True)
    ]
    found = np.array(list(product(*angles)), float)
    return found[np.argsort(np.linalg.norm(found - mounting.preshape, axis=1), kind="stable")]
