"""MuJoCo model of a hand with its drives and an object, as in DexGraspBench.
The object's body frame is at its centre of mass."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from graspd.service.model.matter import ACCELERATION
from graspd.service.model.matter import FRICTION as SLIDING
from graspd.service.model.transforms import Floats, slerp
from graspd.worker.engines.mujoco_warnings import ARENA
from graspd.worker.grasps import Posture
from graspd.worker.hands.jaws import jaws_of
from graspd.worker.hands.model import ConvexPiece, HandModel, JointType
from graspd.worker.hands.tendons import Tendon, actuator_matrix
from graspd.worker.objects.memory_cache import cached_by_content
from graspd.worker.objects.model import ObjectModel
from graspd.worker.simulation.environment import CLEAR_M, Neighbour, Obstacle
from graspd.worker.validation.decomposition import ConvexPieces

#: Sliding and torsional friction; `hard` scales them by `HARD`.
FRICTION: Final = (SLIDING, 0.02)
HARD: Final = (0.5, 0.1)
DAMPING_TIME: Final = 0.02  # joint damping over position gain [s]: 0.1 N m s/rad at the protocol's gain of 5
HAND_SOLIMP: Final = (0.5, 0.99, 1e-4, 0.5, 2.0)
HAND_SOLREF: Final = (0.005, 1.0)
#: Time constant [s] (at least 2 steps) and damping ratio of couplings: stiffer than contacts, which would stretch them.
COUPLING_SOLREF: Final = (0.008, 1.0)
COUPLING_SOLIMP: Final = (0.98, 0.999, 1e-4, 0.5, 2.0)
#: Features of today's MuJoCo that version 3.3.2, pinned by DexGraspBench, lacks: several contacts per pair of convex
#: pieces, and a solver for each island of contacts. They are off here, except for the first with grippers.
NOT_IN_3_3_2: Final = int(mujoco.mjtDisableBit.mjDSBL_MULTICCD) | int(mujoco.mjtDisableBit.mjDSBL_ISLAND)
#: Least number of dofs for sparse Jacobians; MuJoCo's own rule is 60. Lift time, sparse over dense Jacobians:
#: .77 for 28 dofs (Allegro), .73 for 34 (Shadow), 1.09 for 20 (Barrett). Verdicts differ only by rounding.
SPARSE: Final = 24
_BARE_RADIUS: Final = 0.01  # a body without geometry has the inertia of a ball of this radius [m]
_MIN_MASS: Final = 1e-3
#: Numerical tolerance of fingertips that may touch a support [m]: the trajectory is checked in steps.
TOUCH_ROUNDING_M: Final = 1e-4


@dataclass(frozen=True)
class MujocoOptions:
    """Options of the engine that differ between validation levels."""

    timestep: float = 0.004
    noslip_iterations: int = 2
    root: str = "weld"
    """weld: free root, welded to a mocap body (the protocol); fixed: the root itself is the mocap body."""
    friction: tuple[float, float] = FRICTION
    """Sliding and torsional friction with an object of default friction; scaled for other objects."""

    def hardened(self) -> MujocoOptions:
        """Return the options with the friction of the hard protocol, `HARD`."""
        slide, twist = self.friction
        return replace(self, friction=(slide * HARD[0], twist * HARD[1]))


#: Coarse physics for clear cases at level fast. Contacts between hand and object have a time constant of 12.5 ms, above
#: two steps of up to 6 ms. They are therefore as stiff as at 4 ms; at 8 ms they are softer.
COARSE: Final = MujocoOptions(timestep=0.006, root="fixed")


@dataclass(frozen=True)
class FreeBody:
    """Addresses of a neighbour in a compiled model; its body frame is at its centre of mass."""

    body: int
    qpos: int
    centre: Floats
    mass: float


@dataclass(frozen=True)
class Scene:
    """Compiled model with its addresses. It is read-only: threads share it, each with its own data."""

    model: Any
    hand: HandModel
    physics: MujocoOptions
    hand_geoms: NDArray[np.bool_]
    object_body: int
    object_qpos: int
    root_qpos: int  # -1 if the root is fixed
    joint_qpos: NDArray[np.intp]  # (J,) in `HandModel.joint_names` order
    dof_gain: Floats  # (D,) `dof_gain * q + dof_shift` is the position of each dof's leading joint
    dof_shift: Floats
    pulls: Floats | None
    """(A, D) matrix from positions of leading joints to the actuators' controls; None if both are equal."""
    centre: Floats  # (3,) the object's centre of mass in the object frame
    mass: float
    support_geoms: NDArray[np.bool_]
    """(G,) geoms of the scene's supports and neighbours; the scene frame is the mocap body 1."""
    neighbours: tuple[FreeBody, ...]
    tip_geoms: NDArray[np.bool_]
    pressing: Floats
    """(G,) allowed depth of fingertips in each geom on the approach [m]; above 0 where contact is allowed."""

    @property
    def push_force(self) -> float:
        """Force of a push, and weight of the object [N]."""
        return ACCELERATION * self.mass

    def set_posture(self, data: Any, hand_pose: Floats, joints: Floats) -> None:
        """Reset `data` with the hand in a posture (7,), (J,) and the object at its initial pose."""
        mujoco.mj_resetData(self.model, data)
        data.qpos[self.object_qpos : self.object_qpos + 7] = [*self.centre, 1, 0, 0, 0]
        data.qpos[self.joint_qpos] = joints
        if self.root_qpos >= 0:
            data.qpos[self.root_qpos : self.root_qpos + 7] = hand_pose
        self.command(data, hand_pose, joints)

    def command(self, data: Any, hand_pose: Floats, joints: Floats) -> None:
        """Set the target posture of actuators and root."""
        data.mocap_pos[0] = hand_pose[:3]
        data.mocap_quat[0] = hand_pose[3:]
        data.ctrl[:] = self.controls(joints)

    def controls(self, joints: Floats) -> Floats:
        """Return targets (..., A) of the actuators for joint positions (..., J)."""
        values: Floats = self.hand.reduce(joints) * self.dof_gain + self.dof_shift
        return values if self.pulls is None else values @ self.pulls.T


def build_scene(
    hand: HandModel,
    obj: ObjectModel,
    pieces: ConvexPieces,
    physics: MujocoOptions,
    supports: Sequence[Obstacle] = (),
    neighbours: Sequence[Neighbour] = (),
    carrier: Callable[[Any], Any] | None = None,
) -> Scene:
    """Compile the scene of a hand and an object, with supports and neighbours, if any; see `scene_spec`."""
    model = scene_spec(hand, obj, pieces, physics, supports, neighbours, carrier).compile()
    if model.nv >= SPARSE:
        model.opt.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
    lead = hand.joint_body[hand.first_joint]
    body_of_geom = model.geom_bodyid
    object_body = model.body("object").id
    beside = []
    for k, one in enumerate(neighbours):
        at, qpos = model.body(f"neighbour{k}").id, int(model.joint(f"neighbour{k}").qposadr[0])
        beside.append(FreeBody(at, qpos, one.obj.centre_of_mass, float(model.body_mass[at])))
    stand = [one.body for one in beside] + ([model.body("supports").id] if supports else [])
    support = np.isin(body_of_geom, stand)
    return Scene(
        model=model,
        hand=hand,
        physics=physics,
        hand_geoms=np.asarray((body_of_geom != object_body) & ~support),
        object_body=object_body,
        object_qpos=int(model.joint("object").qposadr[0]),
        root_qpos=int(model.joint("root").qposadr[0]) if physics.root == "weld" and carrier is None else -1,
        joint_qpos=np.array([int(model.joint(f"joint{b}").qposadr[0]) for b in hand.joint_body], np.intp),
        dof_gain=hand.multiplier[lead],
        dof_shift=hand.offset[lead],
        pulls=actuator_matrix(hand.tendons, hand.dofs) if hand.tendons else None,
        centre=obj.centre_of_mass,
        mass=obj.mass,
        support_geoms=np.asarray(support),
        neighbours=tuple(beside),
        tip_geoms=np.isin(body_of_geom, [model.body(f"body{b}").id for b in hand.fingertips]),
        pressing=_allowed_depth(model, supports),
    )


scene_of = cached_by_content(8)(build_scene)  # cached `build_scene`; threads share the read-only scene


def _allowed_depth(model: Any, supports: Sequence[Obstacle]) -> Floats:
    out = np.zeros(model.ngeom)
    for i, support in enumerate(supports):
        if support.tips_m is not None and support.tips_m < CLEAR_M:
            out[model.geom(f"support{i}").id] = max(0.0, -support.tips_m) + TOUCH_ROUNDING_M
    return out


def empty_spec(timestep: float) -> Any:
    """Return a spec without bodies, with the protocol's solver and a time step [s]."""
    spec = mujoco.MjSpec()
    # MJCF angles are degrees by default: limits in radians would lock every finger without an error.
    spec.compiler.degree = False
    spec.memory = ARENA
    spec.option.timestep = timestep
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10.0
    return spec


def scene_spec(
    hand: HandModel,
    obj: ObjectModel,
    pieces: ConvexPieces,
    physics: MujocoOptions,
    supports: Sequence[Obstacle] = (),
    neighbours: Sequence[Neighbour] = (),
    carrier: Callable[[Any], Any] | None = None,
) -> Any:
    """Return the spec that `build_scene` compiles.
    `carrier` adds an arm to the spec and returns the hand's root body on it; without it, see `MujocoOptions.root`.
    Names: `body0` ..., `joint1` ..., `dof0` ... (actuators), object, supports, `neighbour0` ..."""
    spec = empty_spec(physics.timestep)
    spec.option.noslip_iterations = physics.noslip_iterations
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_GRAVITY) | (NOT_IN_3_3_2 & ~multi_contact_flags(hand))
    slide, twist = (coefficient * obj.friction / SLIDING for coefficient in physics.friction)
    friction = [slide, twist, 1e-4]
    base = _add_root(spec, physics.root) if carrier is None else carrier(spec)
    add_hand(spec, base, hand, {"condim": 4, "friction": friction, "solimp": HAND_SOLIMP, "solref": HAND_SOLREF})
    add_object(spec, obj, pieces.vertices, friction, obj.mass)
    if supports:
        # The scene's pose in the object frame is that of this mocap body.
        body = spec.worldbody.add_body(name="supports", mocap=True)
        for i, support in enumerate(supports):
            add_support(spec, body.add_geom(condim=4, friction=friction, name=f"support{i}"), support)
    for k, one in enumerate(neighbours):
        add_object(spec, one.obj, one.pieces, friction, one.obj.mass, name=f"neighbour{k}")
    return spec


def multi_contact_flags(hand: HandModel) -> int:
    """Return the flags of `NOT_IN_3_3_2` that a gripper needs: flat pads touch flat sides over an area.
    The protocol is for rounded fingers; at a single contact point the object would rotate unrealistically."""
    return int(mujoco.mjtDisableBit.mjDSBL_MULTICCD) if jaws_of(hand) is not None else 0


def _add_root(spec: Any, root: str) -> Any:
    if root != "weld":
        return spec.worldbody.add_body(name="body0", mocap=True)
    spec.worldbody.add_body(name="mocap", mocap=True)
    base = spec.worldbody.add_body(name="body0")
    base.add_freejoint(name="root")
    spec.add_equality(
        type=mujoco.mjtEq.mjEQ_WELD, objtype=mujoco.mjtObj.mjOBJ_BODY, name1="mocap", name2="body0",
        solimp=[0.9, 0.95, 0.001, 0.5, 2.0], data=equality_data(0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 1),
    )  # fmt: skip
    return base


def add_hand(spec: Any, base: Any, hand: HandModel, contact: dict[str, Any]) -> None:
    """Add a hand with its drives below its root body `base`; `contact` has properties of all geoms.
    Names: `body1` ..., `joint1` ..., `hand0` ... (geoms and their meshes), `dof0` ... (actuators and tendons)."""
    add_bodies(spec, base, hand, contact)
    _add_actuators(spec, hand)
    for a, b in sorted(hand.neighbours):
        spec.add_exclude(bodyname1=f"body{a}", bodyname2=f"body{b}")


def add_bodies(
    spec: Any,
    base: Any,
    hand: HandModel,
    contact: dict[str, Any],
    names: tuple[str, str, str] = ("body", "joint", "hand"),
) -> list[Any]:
    """Add bodies, joints and geoms, whose names begin with `names`; return all bodies (L,)."""
    bodies = [base]
    for b in range(1, hand.bodies):
        pose = hand.origin[b]
        body = bodies[hand.parent[b]].add_body(name=f"{names[0]}{b}", pos=pose[:3], quat=pose[3:])
        _add_joint(body, hand, b, f"{names[1]}{b}")
        bodies.append(body)
    for b, body in enumerate(bodies):
        _add_mass_and_geoms(spec, body, hand, b, contact, names[2])
    return bodies


def _add_joint(body: Any, hand: HandModel, b: int, name: str) -> None:
    revolute = hand.joint_type[b] == JointType.REVOLUTE
    d, m, shift = int(hand.dof[b]), float(hand.multiplier[b]), float(hand.offset[b])
    ends = sorted((m * float(hand.lower[d]) + shift, m * float(hand.upper[d]) + shift))
    found: dict[str, Any] = {}
    if hand.drag is not None:
        found |= {"armature": float(hand.drag.armature[b]), "frictionloss": float(hand.drag.dry_friction[b])}
    if any(d in tendon.dofs for tendon in hand.tendons):
        found |= {"solref_limit": COUPLING_SOLREF, "solimp_limit": COUPLING_SOLIMP}
    body.add_joint(
        name=name,
        type=mujoco.mjtJoint.mjJNT_HINGE if revolute else mujoco.mjtJoint.mjJNT_SLIDE,
        axis=hand.axis[b],
        range=ends,
        limited=mujoco.mjtLimited.mjLIMITED_TRUE,
        damping=[DAMPING_TIME * float(hand.stiffness[d]), 0, 0],
        **found,
    )


def _add_mass_and_geoms(spec: Any, body: Any, hand: HandModel, b: int, contact: dict[str, Any], name: str) -> None:
    mass = max(float(hand.masses[b]), _MIN_MASS)
    mine = [(i, p) for i, p in enumerate(hand.pieces) if p.body == b]
    if not mine:
        body.mass = mass
        body.inertia = np.full(3, 0.4 * mass * _BARE_RADIUS**2)
        body.ipos, body.explicitinertial = [0, 0, 0], True
        return
    share = np.array([float(np.prod(np.ptp(p.vertices, axis=0))) for _, p in mine])
    for (i, p), part in zip(mine, share / share.sum(), strict=True):
        add_shape(spec, body.add_geom(**contact, mass=mass * float(part), name=f"{name}{i}"), p, f"{name}{i}")


def add_shape(spec: Any, geom: Any, piece: ConvexPiece, name: str) -> None:
    """Set a geom to the shape of a convex piece, in its body's frame."""
    if piece.kind == "hull":
        add_mesh(spec, geom, piece.vertices, name)
        return
    geom.type = getattr(mujoco.mjtGeom, f"mjGEOM_{piece.kind.upper()}")
    geom.pos, geom.quat = piece.pose[:3], piece.pose[3:]
    if piece.kind == "box":
        geom.size = np.array(piece.size) / 2
    elif piece.kind == "sphere":
        geom.size = [piece.size[0], 0, 0]
    else:
        geom.size = [piece.size[0], piece.size[1] / 2, 0]


def add_mesh(spec: Any, geom: Any, vertices: Floats, name: str) -> None:
    """Set a geom to the convex hull of points (V, 3)."""
    mesh = spec.add_mesh(name=name)
    mesh.uservert = np.ascontiguousarray(vertices, np.float32).ravel()
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
    geom.type = mujoco.mjtGeom.mjGEOM_MESH
    geom.meshname = name


def _add_actuators(spec: Any, hand: HandModel) -> None:
    leading = hand.joint_body[hand.first_joint]
    pulled = {d: tendon for tendon in hand.tendons for d in tendon.dofs}
    for d, lead in enumerate(leading):
        if (tendon := pulled.get(d)) is not None:
            if d == min(tendon.dofs):
                _add_tendon(spec, hand, tendon, f"dof{d}", leading)
            continue
        # The actuator acts on one joint: the dof's gain and limit are converted by this joint's multiplier.
        m = float(hand.multiplier[lead])
        actuator = spec.add_actuator(name=f"dof{d}", target=f"joint{lead}", trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_position(kp=float(hand.stiffness[d]) / m**2)
        _limit_effort(actuator, float(hand.effort[d]) / abs(m))
        for b in np.flatnonzero(hand.dof == d):
            if b == lead:
                continue
            ratio = float(hand.multiplier[b]) / m
            start = float(hand.offset[b]) - ratio * float(hand.offset[lead])
            spec.add_equality(
                type=mujoco.mjtEq.mjEQ_JOINT,
                objtype=mujoco.mjtObj.mjOBJ_JOINT,
                name1=f"joint{b}",
                name2=f"joint{lead}",
                data=equality_data(start, ratio),
                solref=COUPLING_SOLREF,
                solimp=COUPLING_SOLIMP,
            )


def add_object(
    spec: Any, obj: ObjectModel, pieces: Sequence[Floats], friction: list[float], mass: float, name: str = "object"
) -> None:
    """Add a free body of `mass` [kg] from corners (V, 3) of each piece; frame at the centre of mass."""
    body = spec.worldbody.add_body(name=name, pos=obj.centre_of_mass)
    body.add_freejoint(name=name)
    # By default MuJoCo would place the centre of mass at the body's position in its parent.
    body.mass, body.ipos = mass, [0, 0, 0]
    body.fullinertia = (mass * obj.inertia)[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    body.explicitinertial = True
    for i, corners in enumerate(pieces):
        geom = body.add_geom(condim=4, friction=friction, name=f"{name}-{i}")
        add_mesh(spec, geom, corners - obj.centre_of_mass, f"{name}-{i}")


def add_support(spec: Any, geom: Any, support: Obstacle) -> None:
    """Set a geom to the plane or convex solid of a support, in the frame of the support."""
    if len(support.corners):
        add_mesh(spec, geom, support.corners, geom.name)
        return
    normal, offset = support.planes[0, :3], support.planes[0, 3]
    geom.type, geom.size, geom.pos = mujoco.mjtGeom.mjGEOM_PLANE, [0, 0, 0.1], offset * normal
    mujoco.mju_quatZ2Vec(geom.quat, normal)


def interpolate_postures(a: Posture, b: Posture, row: int, share: float) -> tuple[Floats, Floats]:
    """Interpolate postures a and b at `share`: positions and joints linearly, orientations by slerp."""
    start, end = a.hand_pose[row], b.hand_pose[row]
    pose = np.concatenate([(1 - share) * start[:3] + share * end[:3], slerp(start[3:], end[3:], share)])
    return pose, (1 - share) * a.joint_positions[row] + share * b.joint_positions[row]


def _add_tendon(spec: Any, hand: HandModel, tendon: Tendon, name: str, leading: NDArray[np.int32]) -> None:
    """Add one actuator on the weighted sum of a tendon's joints, which have no other coupling."""
    cord = spec.add_tendon(name=name)
    for d, pull in zip(tendon.dofs, tendon.coefficients, strict=True):
        cord.wrap_joint(f"joint{leading[d]}", pull)
    actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_TENDON)
    actuator.set_to_position(kp=tendon.gain(hand.stiffness))
    _limit_effort(actuator, tendon.limit(hand.effort))


def _limit_effort(actuator: Any, effort: float) -> None:
    actuator.forcerange = [-effort, effort]
    actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE


def equality_data(*values: float) -> Floats:
    data = np.zeros(mujoco.mjNEQDATA)
    data[: len(values)] = values
    return data
