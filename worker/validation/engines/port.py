"""Port of physics engines: input and duties of an adapter. Units are SI; quaternions are w x y z.

The protocol (`worker.validation.engines.trial`) is written once, on top of this port. An adapter builds the model,
follows targets, applies one force, and returns the object's pose. No engine has gravity: the weight of the object is
part of the force, and the hand has no weight."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from graspd.service.model.transforms import Floats
from graspd.worker.hands.model import ConvexPiece, JointType
from graspd.worker.simulation.environment import Obstacle


@dataclass(frozen=True)
class Link:
    """One rigid body of the hand. Link 0 is the root; link k > 0 moves by joint k relative to its parent."""

    parent: int  # -1 for the root; smaller than the link's own index
    joint: JointType  # FIXED only for the root
    origin: Floats  # (7,) pose of the joint frame in the parent's frame; the link's frame at joint position 0
    axis: Floats  # (3,) unit axis in the joint frame
    limits: tuple[float, float]  # [rad or m]
    damping: float  # viscous: torque per joint velocity [N m s/rad or N s/m]
    armature: float  # inertia of the drive's rotor, added to the joint [kg m^2 or kg]
    dry_friction: float  # [N m or N]
    mass: float  # [kg]
    centre: Floats  # (3,) centre of mass in the link's frame
    inertia: Floats  # (3, 3) about the centre of mass, in the axes of the link's frame [kg m^2]
    pieces: tuple[ConvexPiece, ...]  # collision shapes in the link's frame


@dataclass(frozen=True)
class Drive:
    """Position controller of one joint, or of a tendon: a weighted sum of joint positions.
    Pull F = gain * (target - position), limited to +-effort, where both are sums of coefficient * joint position.
    Each joint receives coefficient * F; velocities are damped by the joint (`Link.damping`), not by the drive."""

    joints: tuple[int, ...]
    coefficients: tuple[float, ...]  # (1.0,) for a drive of one joint
    gain: float
    effort: float


@dataclass(frozen=True)
class Coupling:
    """Mimic joint: position of `follower` = ratio * position of `leader` + offset. The leader is driven."""

    follower: int
    leader: int
    ratio: float
    offset: float


@dataclass(frozen=True)
class RigidObject:
    """The free object. Its body frame is at the centre of mass, with the axes of the mesh's frame."""

    pieces: tuple[Floats, ...]  # corners (V, 3) of convex pieces in the body frame
    mass: float
    inertia: Floats  # (3, 3) about the centre of mass [kg m^2]
    centre: Floats  # (3,) centre of mass in the object's frame; the protocol measures motion of the object's frame


@dataclass(frozen=True)
class EngineModel:
    """All that is simulated for one hand and one object."""

    links: tuple[Link, ...]
    drives: tuple[Drive, ...]
    couplings: tuple[Coupling, ...]
    ignored: frozenset[tuple[int, int]]
    """Pairs of links (a < b) without contact; all other pairs of links collide. Includes parents and children."""
    obj: RigidObject
    friction: float  # Coulomb coefficient of all contacts, static and dynamic
    torsional_friction_m: float
    """Torque about a contact's normal per normal force [m]; an engine without it says so in its module."""
    supports: tuple[Obstacle, ...] = ()  # fixed half-spaces (no corners) and convex solids, in the world frame


@dataclass(frozen=True)
class Motion:
    """T targets in turn, under one constant force on the object."""

    root: Floats  # (T, 7) pose of link 0 in the world; the root follows it rigidly, or by a stiff weld
    joints: Floats  # (T, L) target positions by link; column 0 (the root) is unused
    seconds: Floats  # (T,) time for which each target applies
    force: Floats  # (3,) at the object's centre of mass, in the world [N]
    displacement: Floats  # (T, 3) expected displacement of the object at the end of each target; 0 except in lifts [m]


@dataclass(frozen=True)
class Trial:
    """One grasp. World frame: that of the scene, or of the object at the start if there are no supports."""

    object_pose: Floats  # (7,) of the object's body frame (centre of mass) at the start, at rest
    root: Floats  # (7,) of link 0 at the start: the pregrasp
    joints: Floats  # (L,) joint positions by link at the start; also the first targets
    closing: Motion  # from pregrasp through grasp to squeeze
    tests: tuple[Motion, ...]  # each starts from the closed hand: six pushes, or one lift with its hold


class Simulation(Protocol):
    """One model in one engine. It owns its state: one thread at a time."""

    def reset(self, object_pose: Floats, root: Floats, joints: Floats) -> None:
        """Place object (7,), root (7,) and joints (L,) at rest, with these as targets, without force."""

    def run(self, root: Floats, joints: Floats, force: Floats, seconds: float) -> int:
        """Simulate under constant targets and force; the root may move to its target evenly over the time.
        Return the number of steps."""

    def object_pose(self) -> Floats:
        """Return the pose (7,) of the object's body frame in the world; not finite if the simulation diverged."""

    def save(self) -> Any:
        """Return the present state."""

    def restore(self, state: Any) -> None:
        """Return to a saved state."""


class Engine(Protocol):
    """Module of one engine, imported at its first use; it states solver, contact model and time step."""

    def limitations(self, model: EngineModel) -> Sequence[str]:
        """Return what this engine cannot simulate in a model, each as a short noun phrase; empty if nothing."""

    def simulation(self, model: EngineModel) -> Simulation:
        """Build a model."""
