"""Common, checked result of the URDF, MJCF and USD readers: links with shapes, and a tree of joints."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.errors import HandError, LimitError
from graspd.service.model.transforms import Floats
from graspd.worker.objects.disk_cache import TOLD_IF_SET

Ints = NDArray[np.int32]

MAX_LINKS: Final = 256
MAX_SHAPES: Final = 1024
#: Largest distance of a part from its parent [m]; larger numbers are a unit mistake.
MAX_LENGTH_M: Final = 10.0
#: Limit in each direction of a prismatic joint without limits [m]; a hand must not move by such a joint.
UNLIMITED_M: Final = 10.0
MOVING: Final = ("revolute", "continuous", "prismatic")
#: URDF joint types of a floating base.
FREE: Final = ("floating", "planar")


@dataclass(frozen=True)
class Shape:
    """Shape of a link. Size: box x y z; sphere r; cylinder and capsule r, length [m]; mesh: its scale."""

    kind: str
    size: tuple[float, ...]
    pose: Floats
    filename: str = ""  # file of a mesh
    mesh: tuple[Floats, Ints] | None = None
    """Vertices (V, 3) and triangles (F, 3) of a mesh that the robot's reader has loaded."""
    colour: tuple[float, float, float] | None = None
    """sRGB, 0 .. 1, of a visual element; None if not stated or in the mesh file."""


@dataclass(frozen=True)
class Link:
    """A link; mass is None if the robot's description gives none."""

    name: str
    shapes: tuple[Shape, ...]  # collision elements
    mass: float | None
    visuals: tuple[Shape, ...] = ()


@dataclass(frozen=True)
class Mimic:
    """value = multiplier * value of `joint` + offset."""

    joint: str
    multiplier: float
    offset: float


@dataclass(frozen=True)
class Joint:
    """A joint with a unit axis; limits of moving joints are finite and ordered."""

    name: str
    type: str
    parent: str
    child: str
    origin: Floats
    axis: Floats = field(default_factory=lambda: np.array([1.0, 0, 0]))
    lower: float = 0.0
    upper: float = 0.0
    effort: float = 0.0  # limit [N m or N]; 0 if not stated
    mimic: Mimic | None = None
    """Own limits of a URDF follower are ignored, as in ROS: most published ones are wrong."""
    velocity: float = 0.0  # limit [rad/s or m/s]; 0 if not stated
    stiffness: float = 0.0  # position gain of the joint's servo [N m/rad or N/m]; 0 if not stated
    armature: float = field(default=0.0, metadata=TOLD_IF_SET)
    """Inertia that the drive adds [kg m^2 or kg]; 0 if not stated."""
    dry_friction: float = field(default=0.0, metadata=TOLD_IF_SET)  # [N m or N]; 0 if not stated
    fault: str = field(default="", metadata=TOLD_IF_SET)
    """Error for a hand that moves by this joint. Above a hand the joint is fixed and the fault is ignored."""

    @property
    def is_movable(self) -> bool:
        return self.type in MOVING and not self.fault


@dataclass(frozen=True)
class Robot:
    """Checked description: links and joints form one tree."""

    name: str
    links: dict[str, Link]
    joints: dict[str, Joint]
    root: str
    notes: tuple[str, ...] = field(default=())  # accepted anomalies to report to the user
    format: str = "URDF"
    tendons: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """Drives that pull several joints: the coefficient of each joint."""


def build_robot(
    name: str,
    links: Iterable[Link],
    joints: Iterable[Joint],
    notes: Iterable[str],
    filename: str,
    fmt: str = "URDF",
    tendons: Mapping[str, Mapping[str, float]] | None = None,
) -> Robot:
    """Build a robot from links and joints with checked values.
    Raises HandError: duplicate names, joints that form no tree, empty limits, no moving joint, or no collision shape.
    LimitError: more links or shapes than a hand has."""
    link_of, joint_of = _by_name(links, f"{filename}: duplicate link"), _by_name(joints, f"{filename}: duplicate joint")
    if len(link_of) > MAX_LINKS or sum(len(link.shapes) for link in link_of.values()) > MAX_SHAPES:
        raise LimitError(f"{filename}: more than {MAX_LINKS} links or {MAX_SHAPES} collision elements")
    root = _check_tree(link_of, joint_of, filename)
    _check_limits(joint_of.values(), filename)
    joint_of = {name: _checked_mimic(joint, joint_of, filename) for name, joint in joint_of.items()}
    if not any(joint.is_movable for joint in joint_of.values()):
        if faults := [joint.fault for joint in joint_of.values() if joint.fault]:
            raise HandError(faults[0])
        raise HandError(f"{filename}: no moving joint; a hand needs at least one revolute or prismatic joint")
    if not any(link.shapes for link in link_of.values()):
        fixes = {"MJCF": "give geoms a contype and conaffinity", "USD": "apply PhysicsCollisionAPI to meshes"}
        add = fixes.get(fmt, "add <collision> elements")
        raise HandError(f"{filename}: no link has collision geometry, so nothing can touch; {add}")
    return Robot(name, link_of, joint_of, root, tuple(notes), fmt, tendons or {})


def _by_name(parts: Iterable[Any], duplicate: str) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for part in parts:
        if part.name in found:
            raise HandError(f"{duplicate} name {part.name!r}; rename one of them")
        found[part.name] = part
    return found


def joint_chain(robot: Robot, link: str) -> tuple[Joint, ...]:
    """Return the joints from the robot's root to a link."""
    carrier = {joint.child: joint for joint in robot.joints.values()}
    found: list[Joint] = []
    while link in carrier:
        found.insert(0, carrier[link])
        link = carrier[link].parent
    return tuple(found)


def _check_tree(links: dict[str, Link], joints: dict[str, Joint], filename: str) -> str:
    parent_of: dict[str, str] = {}
    for joint in joints.values():
        for end, link in (("parent", joint.parent), ("child", joint.child)):
            if link not in links:
                raise HandError(f"{filename}: joint {joint.name!r} names the {end} link {link!r}, which does not exist")
        if joint.child in parent_of:
            raise HandError(f"{filename}: link {joint.child!r} has two parents, a kinematic loop; cut one joint")
        parent_of[joint.child] = joint.parent
    roots = [name for name in links if name not in parent_of]
    if len(roots) != 1:
        if not links and filename.endswith(".xacro"):
            raise HandError(
                f"{filename}: it expands to no link at all: it only defines macros (give the file that calls them), or "
                "an <include> lacks its xacro: prefix"
            )
        if not links:
            raise HandError(f"{filename}: it contains no link; give the description of a hand")
        found = ", ".join(map(repr, roots[:3])) or "none: the joints form a cycle"
        raise HandError(f"{filename}: a hand needs exactly one root link; found {found}")
    for link in links:
        at = link
        for _ in links:
            at = parent_of.get(at, at)
        if at != roots[0]:
            raise HandError(f"{filename}: the joints above link {link!r} form a loop without a root")
    return roots[0]


def _check_limits(joints: Iterable[Joint], filename: str) -> None:
    """Refuse a robot whose limits are all zero: CAD exporters write zero for unstated limits."""
    limited = [joint for joint in joints if joint.is_movable and joint.type != "continuous" and joint.mimic is None]
    if limited and all(joint.lower == joint.upper == 0 for joint in limited):
        many = f"all {len(limited)} joints have" if len(limited) > 1 else f"joint {limited[0].name!r} has"
        raise HandError(f"{filename}: {many} limits 0 .. 0: the exporter left them empty; fill them in")


def _checked_mimic(joint: Joint, joints: dict[str, Joint], filename: str) -> Joint:
    """Return the joint; it gets a fault if it follows itself or a joint that does not move."""
    seen, at = {joint.name}, joint
    while at.mimic is not None:
        target = joints.get(at.mimic.joint)
        if target is None or not (target.is_movable or target.fault):
            fault = f"{filename}: joint {at.name!r} mimics {at.mimic.joint!r}, which is no moving joint"
        elif target.name in seen:
            fault = f"{filename}: joint {target.name!r} mimics itself through a cycle; free one joint"
        else:
            seen.add(target.name)
            at = target
            continue
        return replace(joint, fault=fault, mimic=None)
    return joint
