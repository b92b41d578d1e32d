"""Convert a robot's joints to a hand's tree of bodies: root, merged fixed joints, resolved mimics."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from graspd.service.model.errors import HandError, did_you_mean
from graspd.service.model.transforms import IDENTITY_POSE, Floats, compose, quat_from_axis_angle
from graspd.worker.hands.options import HandOptions
from graspd.worker.hands.robot import MAX_LENGTH_M, UNLIMITED_M, Joint, Mimic, Robot
from graspd.worker.hands.tendons import check_tendons

#: Share of its range that a drive may lose without a note to the user.
_TOLD_CUT: Final = 0.01
#: Largest travel and offset of a follower: of a revolute joint [rad], of a prismatic joint [m].
_MOST: Final = (200 * math.pi, MAX_LENGTH_M)
#: A joint with a smaller range is fixed [rad or m].
LEAST_RANGE: Final = 1e-5


@dataclass(frozen=True)
class Body:
    """A body and the moving joint that carries it."""

    name: str
    parent: int = -1
    joint: Joint | None = None
    origin: Floats = field(default_factory=IDENTITY_POSE.copy)
    """(7,) pose of the joint frame in the parent's body frame."""


@dataclass(frozen=True)
class Tree:
    """Bodies with parents first; body 0 is the root."""

    bodies: tuple[Body, ...]
    links: dict[str, tuple[int, Floats]]  # body of each retained link, and its pose in the body's frame
    drives: dict[str, Mimic]  # degree of freedom that each moving joint follows, by name of the joint
    joint_names: tuple[str, ...]  # moving joints in the robot's order
    dof_names: tuple[str, ...]  # independent joints in the robot's order
    lower: Floats
    upper: Floats
    velocity: Floats
    still: tuple[str, ...]  # joints fixed because their limits leave one value
    known: frozenset[str]  # names of all joints and links of the robot, dropped and frozen ones too


def build_tree(robot: Robot, options: HandOptions) -> Tree:
    """Build the body tree of a hand.
    Raises HandError: an option names an unknown joint or link, nothing moves, or couplings leave a dof no range."""
    _check_names(robot, options)
    # A joint on a tendon follows nothing: it is free within its limits.
    pulled = {joint for pulls in (options.tendons or {}).values() for joint in pulls}
    mimics = {name: None if name in pulled else joint.mimic for name, joint in robot.joints.items()}
    mimics |= {name: Mimic(c.of, c.multiplier, c.offset) for name, c in options.couplings.items()}
    root = pick_root(robot, options)
    kept = _hand_joints(robot, root, set(options.drop))
    for joint in kept:
        if joint.fault and joint.name not in options.fix:
            raise HandError(joint.fault)
    # Joints that follow nothing and whose limits leave one value.
    still = {
        joint.name: joint.lower
        for joint in kept
        if joint.is_movable
        and mimics[joint.name] is None
        and joint.name not in options.fix
        and joint.upper - joint.lower < LEAST_RANGE
    }
    fixed = still | options.fix
    drives = {j.name: _resolve_drive(j.name, mimics, fixed) for j in kept if j.type != "fixed"}
    frozen = {name: drive for name, drive in drives.items() if isinstance(drive, float)}
    moving = {name: drive for name, drive in drives.items() if isinstance(drive, Mimic)}
    for name, drive in moving.items():
        if drive.joint not in moving:
            raise HandError.with_fixes(
                f"joint {name!r} follows {drive.joint!r}, which is dropped",
                f"fix it: --fix {name}=0",
                {"fix": {name: 0}},
            )
    if not moving:
        if still:
            shown = ", ".join(list(still)[:6]) + (", ..." if len(still) > 6 else "")
            raise HandError(f"no moving joint is left: the limits of {shown} leave one value; fill them in")
        if options.fix or options.drop:
            raise HandError("no moving joint is left; fix or drop fewer joints")
        fault = f"no moving joint is left; nothing below {root!r} moves"
        raise HandError.with_fixes(fault, "name another --root", {"root": None})
    names = tuple(name for name in robot.joints if name in moving)
    dofs = tuple(name for name in names if moving[name].joint == name)
    lower, upper = np.array([_fold_limits(dof, moving, robot, options) for dof in dofs]).T
    velocity = np.array([_fold_velocity(dof, moving, robot) for dof in dofs])
    known = frozenset(robot.joints) | frozenset(robot.links)
    bodies, links = _collect_bodies(root, kept, frozen)
    return Tree(bodies, links, moving, names, dofs, lower, upper, velocity, tuple(still), known)


def _check_names(robot: Robot, options: HandOptions) -> None:
    joints = [*options.fix, *options.couplings, *(c.of for c in options.couplings.values())]
    links = [*options.drop, *([options.root] if options.root else [])]
    for kind, names, known in (("joint", joints, set(robot.joints)), ("link", links, set(robot.links))):
        for name in names:
            if name not in known:
                raise HandError(f"the {robot.format} has no {kind} {name!r}{did_you_mean(name, known)}")
            if kind == "joint" and robot.joints[name].type == "fixed":
                raise HandError(f"joint {name!r} is fixed, so it cannot have a value or a coupling")
    check_tendons(robot, options.tendons or {})


def _joints_by_parent(joints: Iterable[Joint]) -> dict[str, list[Joint]]:
    found: dict[str, list[Joint]] = {}
    for joint in joints:
        found.setdefault(joint.parent, []).append(joint)
    return found


def _hand_joints(robot: Robot, root: str, drop: set[str]) -> list[Joint]:
    """Return joints below the root and not below a dropped link, in the robot's order."""
    children = _joints_by_parent(robot.joints.values())
    kept: set[str] = set()
    stack = [root]
    while stack:
        for joint in children.get(stack.pop(), []):
            if joint.child not in drop:
                kept.add(joint.name)
                stack.append(joint.child)
    return [joint for joint in robot.joints.values() if joint.name in kept]


def _resolve_drive(name: str, mimics: Mapping[str, Mimic | None], fixed: Mapping[str, float]) -> Mimic | float:
    """Return the drive of a joint through a chain of mimics, or its value if a fixed joint ends the chain."""
    multiplier, offset, at = 1.0, 0.0, name
    for _ in mimics:
        if at in fixed:
            return multiplier * fixed[at] + offset
        mimic = mimics[at]
        if mimic is None:
            return Mimic(at, multiplier, offset) if abs(multiplier) > 1e-9 else offset
        offset += multiplier * mimic.offset
        multiplier *= mimic.multiplier
        at = mimic.joint
    raise HandError(f"joint {name!r} mimics itself through {at!r}; free one of them")


def _fold_limits(dof: str, moving: dict[str, Mimic], robot: Robot, options: HandOptions) -> tuple[float, float]:
    """Return a dof's range in which all followers stay within their limits; see `_has_binding_limits`."""
    lower, upper = -math.inf, math.inf
    narrowest = dof
    for name, drive in moving.items():
        if drive.joint != dof:
            continue
        joint = robot.joints[name]
        if not _has_binding_limits(joint, drive, robot, options):
            continue
        if joint.type == "prismatic" and joint.upper - joint.lower >= 2 * UNLIMITED_M:
            fault, fix = f"joint {name!r} slides without a range", f"give it a range, or fix it: --fix {name}=0"
            raise HandError.with_fixes(fault, fix, {"fix": {name: 0}})
        ends = sorted((limit - drive.offset) / drive.multiplier for limit in (joint.lower, joint.upper))
        if ends[0] > lower or ends[1] < upper:
            narrowest = name
        lower, upper = max(lower, ends[0]), min(upper, ends[1])
    if upper - lower < LEAST_RANGE and narrowest != dof:
        joint, drive = robot.joints[narrowest], moving[narrowest]
        raise HandError(
            f"joint {narrowest!r} may only go {joint.lower:g} .. {joint.upper:g}, but follows {dof!r} with "
            f"{drive.multiplier:g}, which leaves {dof!r} no range; correct the coupling or its limits"
        )
    _check_travel(dof, lower, upper, moving, robot)
    return lower, upper


def _check_travel(dof: str, lower: float, upper: float, moving: dict[str, Mimic], robot: Robot) -> None:
    """Check that a follower without binding limits stays within a plausible range."""
    for name, drive in moving.items():
        way, most = abs(drive.multiplier) * (upper - lower), _MOST[robot.joints[name].type == "prismatic"]
        if drive.joint == dof and name != dof and (way > most or abs(drive.offset) > most):
            unit = "m" if robot.joints[name].type == "prismatic" else "rad"
            raise HandError(
                f"joint {name!r} follows {dof!r} with {drive.multiplier:g} and offset {drive.offset:g}, which moves it "
                f"by {max(way, abs(drive.offset)):.3g} {unit}; correct the coupling"
            )


def _has_binding_limits(joint: Joint, drive: Mimic, robot: Robot, options: HandOptions) -> bool:
    """Check whether a joint's own limits bind; those of a URDF follower do not, see `Joint.mimic`."""
    return joint.name == drive.joint or robot.format != "URDF" or joint.name in options.couplings


def joints_beyond_limits(robot: Robot, tree: Tree, options: HandOptions) -> list[str]:
    """Return the joints that follow another joint beyond their own limits, which do not bind them."""
    found = []
    for name in tree.joint_names:
        joint, drive = robot.joints[name], tree.drives[name]
        if not _has_binding_limits(joint, drive, robot, options):
            at = tree.dof_names.index(drive.joint)
            ends = sorted(drive.multiplier * end + drive.offset for end in (tree.lower[at], tree.upper[at]))
            if ends[0] < joint.lower - LEAST_RANGE or ends[1] > joint.upper + LEAST_RANGE:
                found.append(name)
    return found


def reduced_range_notes(robot: Robot, tree: Tree) -> list[str]:
    """Return notes on dofs whose range is reduced by their followers' limits."""
    return [
        f"joints that follow {dof} limit it to {lower:.3g} .. {upper:.3g}"
        for dof, lower, upper in zip(tree.dof_names, tree.lower, tree.upper, strict=True)
        if upper - lower < (1 - _TOLD_CUT) * (robot.joints[dof].upper - robot.joints[dof].lower)
    ]


def _fold_velocity(dof: str, moving: dict[str, Mimic], robot: Robot) -> float:
    """Return the largest speed of a dof at which no joint exceeds its limit; 0 if none is stated."""
    stated = [
        robot.joints[name].velocity / abs(drive.multiplier)
        for name, drive in moving.items()
        if drive.joint == dof and robot.joints[name].velocity > 0
    ]
    return min(stated, default=0.0)


def _collect_bodies(
    root: str, kept: list[Joint], frozen: dict[str, float]
) -> tuple[tuple[Body, ...], dict[str, tuple[int, Floats]]]:
    """Collect bodies depth first; a link behind a fixed or frozen joint joins its parent's body."""
    bodies, links = [Body(root)], {root: (0, IDENTITY_POSE.copy())}
    children = _joints_by_parent(kept)
    stack = children.get(root, [])[::-1]
    while stack:
        joint = stack.pop()
        body, pose = links[joint.parent]
        frame = compose(pose, joint.origin)
        if joint.type == "fixed" or joint.name in frozen:
            links[joint.child] = (body, compose(frame, joint_motion(joint, frozen.get(joint.name, 0.0))))
        else:
            links[joint.child] = (len(bodies), IDENTITY_POSE.copy())
            bodies.append(Body(joint.child, body, joint, frame))
        stack += children.get(joint.child, [])[::-1]
    return tuple(bodies), links


def joint_motion(joint: Joint, value: float) -> Floats:
    """Return the pose (7,) of the child's frame in the joint frame at a joint value [rad or m]."""
    motion = IDENTITY_POSE.copy()
    if joint.type == "prismatic":
        motion[:3] = joint.axis * value
    elif joint.type != "fixed":
        motion[3:] = quat_from_axis_angle(joint.axis, np.asarray(value))
    return motion


#: Largest reach of a finger from the link at which the fingers branch [m]; legs and arms exceed it.
MAX_FINGER_M = 0.35
#: Largest reach of a hand from its first joint [m].
MAX_HAND_M = 0.5


def pick_root(robot: Robot, options: HandOptions) -> str:
    """Return the chosen root, else the robot's, moved past dropped links and joints of an arm or wrist.
    Raises HandError: the robot has several hands, or is an arm without a hand; the message names the hands."""
    if options.root:
        return options.root
    root = robot.root
    while root in options.drop:
        children = [j.child for j in robot.joints.values() if j.parent == root]
        if len(children) != 1:
            raise HandError(f"link {root!r} is dropped and has {len(children)} children; name the new root link")
        root = children[0]
    tree = _JointTree(robot, options)
    root = _link_below_arm(tree, root, options)
    if options.palm or tree.reach[root] <= MAX_HAND_M:
        return root
    hands = hand_links(tree, root)
    if len(hands) == 1:
        return hands[0]
    if hands:
        named = ", or ".join(f"--root {link}" for link in hands[:6])
        raise HandError.with_fixes(
            f"this is a robot with {len(hands)} hands", f"name its hand: {named}", *({"root": one} for one in hands[:6])
        )
    raise HandError.with_fixes(
        "no part of this robot branches into fingers that move",
        "if it has a hand, name it: --root LINK",
        {"root": None},
    )


def hand_links(tree: _JointTree, root: str) -> list[str]:
    """Return the links, from the root down, at which a hand begins: several short fingers branch there."""
    found: list[str] = []
    queue = [root]
    for link in queue:
        if tree.reach[link] <= MAX_FINGER_M and tree.has_shaped_branches(link):
            found.append(link)
        else:
            queue += [joint.child for joint in tree.moving_joints_below(link)]
    return found


class _JointTree:
    """Joint tree of a robot: which joints move or carry moving joints, and how far they reach."""

    def __init__(self, robot: Robot, options: HandOptions) -> None:
        self.robot, self.options = robot, options
        self._children = _joints_by_parent(joint for joint in robot.joints.values() if joint.child not in options.drop)
        self._moves: dict[str, bool] = {}
        self.reach: dict[str, float] = {}
        """Length of the joints below each link, along the longest chain that moves [m]."""
        for link in self._deepest_first(robot.root):
            children = self._children.get(link, [])
            self._moves[link] = any(self.is_free(joint) or self._moves[joint.child] for joint in children)
            ways = [
                float(np.linalg.norm(joint.origin[:3])) + self.reach[joint.child]
                for joint in children
                if self.is_free_below(joint)
            ]
            self.reach[link] = max(ways, default=0.0)

    def _deepest_first(self, root: str) -> list[str]:
        order, stack = [], [root]
        while stack:
            order.append(link := stack.pop())
            stack += [joint.child for joint in self._children.get(link, [])]
        return order[::-1]

    def is_free(self, joint: Joint) -> bool:
        return joint.type != "fixed" and joint.name not in self.options.fix

    def is_free_below(self, joint: Joint) -> bool:
        return self.is_free(joint) or self._moves[joint.child]

    def moving_joints_below(self, link: str) -> list[Joint]:
        return [joint for joint in self._children.get(link, []) if self.is_free_below(joint)]

    def has_shaped_branches(self, link: str) -> bool:
        """Check whether at least two moving branches below a link have shapes."""
        return sum(self._has_shape(joint.child) for joint in self.moving_joints_below(link)) > 1

    def _has_shape(self, link: str) -> bool:
        below = (joint.child for joint in self._children.get(link, []))
        return bool(self.robot.links[link].shapes) or any(map(self._has_shape, below))


def _link_below_arm(tree: _JointTree, root: str, options: HandOptions) -> str:
    """Return the link at which a hand begins: below an arm's last joint before the fingers, else the root."""
    start, at = root, root
    palm = options.palm.link if options.palm else None
    while at != palm:
        onward = tree.moving_joints_below(at)
        if len(onward) != 1:
            # A tree without branches is a single finger, so nothing above it is an arm.
            return start if onward else root
        at = onward[0].child
        start = at if tree.is_free(onward[0]) else start
    return start
