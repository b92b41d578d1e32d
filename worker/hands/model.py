"""Model of a hand for the engine: tree of rigid bodies, map from dofs to joints, convex pieces.

Links joined by fixed joints are merged into one body, so every body except the root has one moving joint. The body
frame is the frame of the link that the moving joint carries. The root frame is the frame of `root_link`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.transforms import Floats
from graspd.worker.hands.primitives import HandFeatures
from graspd.worker.hands.robot import Ints, Joint
from graspd.worker.hands.tendons import Tendon
from graspd.worker.hands.visuals import NO_VISUALS, Visuals
from graspd.worker.objects.disk_cache import TOLD_IF_SET, content_digest


class JointType(IntEnum):
    """Type of the joint that carries a body; `FIXED` only on the root."""

    FIXED = 0
    REVOLUTE = 1
    PRISMATIC = 2


@dataclass(frozen=True)
class ConvexPiece:
    """One convex solid rigidly attached to a body."""

    body: int
    kind: str  # box, sphere, cylinder, capsule or hull
    size: tuple[float, ...]
    """Box: full extents. Sphere: radius. Cylinder, capsule: radius, length along z without caps. Hull: ()."""
    pose: Floats  # (7,) pose of the primitive's frame in the body frame; identity for hulls
    vertices: Floats  # (V, 3) corners of the solid in the body frame [m]; round kinds have a fine tessellation
    faces: Ints  # (F, 3) outward triangles
    link: str  # link to which the piece belongs


@dataclass(frozen=True)
class PalmFrame:
    """Point on the palm's surface and the direction in which the hand approaches."""

    centre: Floats  # (3,) point on the palm surface in the root frame [m]
    approach: Floats  # (3,) unit vector out of the palm, root frame


@dataclass(frozen=True)
class SurfacePoints:
    """Fixed sample of the hand's surface, N points; parts inside another piece have no points."""

    body: Ints  # (N,) body of each point
    position: Floats  # (N, 3) in the body frame [m]
    normal: Floats  # (N, 3) unit, outward, body frame
    area: Floats  # (N,) surface area that the point represents [m^2]

    def __len__(self) -> int:
        return len(self.body)


@dataclass(frozen=True)
class Drag:
    """Inertia and dry friction of each joint's mechanism, by the joint's body; 0 if not stated."""

    armature: Floats  # (L,) inertia of the drive [kg m^2 or kg]
    dry_friction: Floats  # (L,) [N m or N]


@dataclass(frozen=True)
class HandModel:
    """Kinematic tree of L bodies with D independent degrees of freedom (dofs) that drive J moving joints.
    Joint value of body l: ``multiplier[l] * q[dof[l]] + offset[l]``, which includes mimic chains and couplings."""

    name: str
    digest: str
    root_link: str
    body_names: tuple[str, ...]
    parent: Ints  # (L,) index of the parent body, smaller than the body's own; -1 for the root, which is body 0
    joint_type: Ints  # (L,) `JointType` values
    origin: Floats  # (L, 7) pose of the joint frame in the parent's body frame
    axis: Floats  # (L, 3) unit joint axis in the joint frame
    dof: Ints  # (L,) degree of freedom that drives the body's joint; -1 for the root
    multiplier: Floats
    offset: Floats
    dof_names: tuple[str, ...]
    lower: Floats  # (D,) limits [rad or m], narrowed by binding limits of followers
    upper: Floats
    effort: Floats  # (D,) torque or force limit [N m or N]; positive
    stiffness: Floats  # (D,) position gain of the controller, Kp [N m/rad or N/m]
    preshape: Floats  # (D,) posture of the approach
    closing: Floats  # (D,) direction in which the dof closes the hand: -1 or +1; 0 if it does not close
    joint_names: tuple[str, ...]  # (J,) all moving joints, including followers, in the description's order
    joint_body: Ints  # (J,) the body that each joint carries
    palm: PalmFrame
    fingertips: tuple[int, ...]  # bodies at the end of each finger
    pieces: tuple[ConvexPiece, ...]
    neighbours: frozenset[tuple[int, int]]
    """Pairs of bodies (a < b) whose contact is ignored: adjacent, or touching in every posture."""
    masses: Floats  # (L,) mass of each body [kg]: the description's, else from volume at 1000 kg/m^3
    velocity: Floats = field(default_factory=lambda: np.zeros(0))
    """(D,) speed limit [rad/s or m/s], narrowed by the limits of followers; 0 if not stated."""
    arm: tuple[Joint, ...] = ()  # moving and fixed joints from the original robot's root to `root_link`, for export
    visuals: Visuals = NO_VISUALS  # visual meshes
    frames: Mapping[str, tuple[int, Floats]] = field(default_factory=dict)
    """Body of each link, and the link's pose (7,) in the body's frame."""
    tendons: tuple[Tendon, ...] = field(default=(), metadata=TOLD_IF_SET)
    """Drives of several dofs; no dof is on two tendons. The other dofs have their own drives."""
    drag: Drag | None = field(default=None, metadata=TOLD_IF_SET)
    """If None, the validator simulates no drag, as in DexGraspBench's protocol."""
    mounting: HandModel | None = field(default=None, metadata=TOLD_IF_SET)
    """Links above the root that must not collide in scenes; see `worker.hands.mounting`.
    A tree of bodies and wrist joints that starts at the root."""

    @cached_property
    def content(self) -> str:
        """Digest of all fields that `content_digest` includes; `digest` is the digest of the source files."""
        return content_digest(self)

    @cached_property
    def features(self) -> HandFeatures:
        return HandFeatures.from_pieces(self.pieces)

    @property
    def bodies(self) -> int:
        return len(self.parent)

    @property
    def span(self) -> Floats:
        return self.upper - self.lower

    @property
    def dofs(self) -> int:
        return len(self.dof_names)

    def expand(self, q: Floats) -> Floats:
        """Compute joint positions (..., J) in `joint_names` order from dof values (..., D)."""
        body = self.joint_body
        return np.asarray(q)[..., self.dof[body]] * self.multiplier[body] + self.offset[body]

    def reduce(self, joints: Floats) -> Floats:
        """Compute dof values (..., D) from joint positions (..., J), each dof from the first joint it drives."""
        first = self.first_joint
        body = self.joint_body[first]
        return (np.asarray(joints)[..., first] - self.offset[body]) / self.multiplier[body]

    def chain(self, body: int) -> list[int]:
        """Return the bodies from this one up to the root, without the root."""
        found = []
        while body > 0:
            found.append(body)
            body = int(self.parent[body])
        return found

    @cached_property
    def first_joint(self) -> NDArray[np.intp]:
        """(D,) first joint that each dof drives; it carries the dof's actuator in simulations."""
        drives = self.dof[self.joint_body]
        return np.array([int(np.flatnonzero(drives == d)[0]) for d in range(self.dofs)], np.intp)
