"""PhysX 5 on the CPU by SAPIEN (Xiang et al. 2020): TGS, steps of 4 ms, reduced coordinates.

Contacts are rigid, with patch friction and torsional friction."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from typing import Any, Final

import numpy as np

from graspd.service.model.transforms import IDENTITY_POSE, Floats, quat_conjugate, quat_from_matrix, quat_rotate
from graspd.worker.hands.model import ConvexPiece, JointType
from graspd.worker.simulation.environment import Obstacle
from graspd.worker.validation.engines.port import EngineModel, RigidObject

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # SAPIEN warns that the machine has no Vulkan; nothing is rendered
    import sapien
    from sapien import physx

TIMESTEP_S: Final = 0.004
#: Solver iterations per step. Fewer iterations let objects creep: 8 iterations of 8 ms move them up to twice as far.
POSITION_ITERATIONS: Final = 16
VELOCITY_ITERATIONS: Final = 1
CONTACT_OFFSET_M: Final = 0.001
#: Largest speed out of a penetration [m/s]: 3 mm in 15 ms, about the time constant of contacts in MuJoCo.
#: Without this limit, a pregrasp that penetrates by some mm throws the object away.
SEPARATION_M_S: Final = 0.2
#: Stiffness of a coupling over its joints' damping [1/s], divided by 1 + the sum of the squared ratios of its leader.
#: The explicit spring was unstable at twice this value. PhysX's fixed tendons are no alternative: their reaction acts
#: on the wrong joint.
COUPLING: Final = 2000.0
#: Least inertia of a joint over its damping [s]; lighter joints converge slowly. Forces at rest do not depend on it.
ARMATURE_S: Final = 0.01
_GROUPS: Final = 32  # bits of a shape's filter
_RAILS: Final = ("x", "y", "z")
HEAVY_KG: Final = 1e6  # inertia of the root's commanded motion


def limitations(model: EngineModel) -> list[str]:
    """Return what PhysX cannot simulate in a model."""
    found = ["dry friction of joints"] if any(link.dry_friction for link in model.links) else []
    if len(_cliques(model.ignored)) > _GROUPS:
        found.append(f"more than {_GROUPS} groups of links without contact")
    return found


class PhysxSimulation:
    """One scene of PhysX with a hand and an object."""

    def __init__(self, model: EngineModel) -> None:
        self._model, self._fresh = model, True
        self._build()
        names = [joint.name for joint in self._hand.active_joints]
        self._rails = [names.index(axis) for axis in _RAILS]
        column = {b: names.index(str(b)) for b in range(1, len(model.links))}
        self._columns, self._base = list(column.values()), np.zeros(7)
        pulls = np.zeros((len(model.drives) + len(model.couplings), len(names)))
        for row, drive in enumerate(model.drives):
            pulls[row, [column[joint] for joint in drive.joints]] = drive.coefficients
        for row, coupling in enumerate(model.couplings, len(model.drives)):
            pulls[row, column[coupling.follower]], pulls[row, column[coupling.leader]] = 1.0, -coupling.ratio
        self._pulls = pulls
        squares = [sum(two.ratio**2 for two in model.couplings if two.leader == one.leader) for one in model.couplings]
        damping = [model.links[one.follower].damping for one in model.couplings]
        stiff = [COUPLING * d / (1 + square) for d, square in zip(damping, squares, strict=True)]
        self._gain = np.array([*(drive.gain for drive in model.drives), *stiff])
        self._effort = np.array([*(drive.effort for drive in model.drives), *([np.inf] * len(stiff))])

    def _build(self) -> None:
        model = self._model
        physx.set_scene_config(gravity=[0, 0, 0], enable_enhanced_determinism=True)
        physx.set_shape_config(contact_offset=CONTACT_OFFSET_M)
        physx.set_body_config(POSITION_ITERATIONS, VELOCITY_ITERATIONS, sleep_threshold=0.0)
        self._system = physx.PhysxCpuSystem()
        self._system.timestep = TIMESTEP_S
        self._scene = sapien.Scene([self._system])
        self._material = physx.PhysxMaterial(model.friction, model.friction, 0.0)
        #: PhysX's torsional friction is friction coefficient * radius * normal force.
        self._patch_m = model.torsional_friction_m / max(model.friction, 1e-9)
        self._object = self._add_object(model.obj)
        self._hand = self._add_hand(model)
        for support in model.supports:
            self._add_support(support)

    def reset(self, object_pose: Floats, root: Floats, joints: Floats) -> None:
        if not self._fresh:
            self._build()  # else contacts of the last trial remain in PhysX's caches, and verdicts depend on the order
        self._fresh = False
        self._object.entity.pose = _pose(object_pose)
        self._object.linear_velocity = self._object.angular_velocity = np.zeros(3)
        self._base = np.array(root, float)
        self._hand.root_pose = _pose(root)
        self._hand.qpos = self._row(np.zeros(3), joints)
        self._hand.qvel = np.zeros(len(self._pulls.T))

    def run(self, root: Floats, joints: Floats, force: Floats, seconds: float) -> int:
        steps = round(seconds / TIMESTEP_S)
        self._turn(root[3:])
        offset = quat_rotate(quat_conjugate(self._base[3:]), root[:3] - self._base[:3])
        speed = np.array(self._hand.qvel)
        speed[self._rails] = (offset - self._hand.qpos[self._rails]) / seconds
        self._hand.qvel = speed
        hand, push, step, pulls = self._hand, self._object.add_force_torque, self._system.step, self._pulls
        # Springs act explicitly: in PhysX's own drives, damping larger than inertia biases the resting position.
        stretched, stiffness = pulls @ self._row(offset, joints) * self._gain, self._gain[:, None] * pulls
        low, high, still = -self._effort, self._effort, np.zeros(3)
        for _ in range(steps):
            hand.qf = pulls.T @ np.minimum(np.maximum(stretched - stiffness @ hand.qpos, low), high)
            push(force, still)
            step()
        return steps

    def object_pose(self) -> Floats:
        pose = self._object.entity_pose
        return np.array([*pose.p, *pose.q], float)

    def save(self) -> Any:
        return self._system.pack()

    def restore(self, state: Any) -> None:
        self._system.unpack(state)

    def _row(self, offset: Floats, joints: Floats) -> Floats:
        """Return the positions of all joints in PhysX's order."""
        row = np.empty(len(self._pulls.T))
        row[self._rails], row[self._columns] = offset, joints[1:]
        return row

    def _turn(self, rotation: Floats) -> None:
        """Set the orientation of the root at its present position."""
        if abs(rotation @ self._base[3:]) > 1 - 1e-12:
            return
        now = np.array(self._hand.qpos)
        here = quat_rotate(self._base[3:], now[self._rails].astype(float))
        self._base[3:] = rotation
        now[self._rails] = quat_rotate(quat_conjugate(rotation), here)
        self._hand.root_pose, self._hand.qpos = _pose(self._base), now

    def _add_object(self, obj: RigidObject) -> Any:
        body = physx.PhysxRigidDynamicComponent()
        for corners in obj.pieces:
            body.attach(self._shape_of_hull(corners, [1, 1, 0, 0]))
        _set_mass(body, obj.mass, np.zeros(3), obj.inertia)
        self._add([body])
        return body

    def _add_support(self, support: Obstacle) -> None:
        body = physx.PhysxRigidStaticComponent()
        if len(support.corners):
            body.attach(self._shape_of_hull(support.corners, [1, 1, 0, 0]))
        else:
            normal, offset = support.planes[0, :3], support.planes[0, 3]
            plane = physx.PhysxCollisionShapePlane(self._material)
            plane.local_pose = _pose(np.array([*(offset * normal), 1, 0, 0, 0])) * _x_axis(normal)
            body.attach(self._filtered(plane, [1, 1, 0, 0]))
        self._add([body])

    def _add(self, bodies: list[Any]) -> None:
        entities = [sapien.Entity() for _ in bodies]
        for entity, body in zip(entities, bodies, strict=True):
            entity.add_component(body)
        for entity in entities:
            self._scene.add_entity(entity)

    def _add_hand(self, model: EngineModel) -> Any:
        """Add the hand on three rails so heavy that only commands move them."""
        groups = [0] * len(model.links)
        for bit, clique in enumerate(_cliques(model.ignored)):
            for b in clique:
                groups[b] |= 1 << bit
        rails: list[Any] = [physx.PhysxArticulationLinkComponent(None)]
        rails += [physx.PhysxArticulationLinkComponent(rails[0])]
        rails += [physx.PhysxArticulationLinkComponent(rails[1])]
        links: list[Any] = []
        for b, link in enumerate(model.links):
            body = physx.PhysxArticulationLinkComponent(links[link.parent] if b else rails[2])
            for piece in link.pieces:
                body.attach(self._shape(piece, [1, 1, groups[b], 1]))
            _set_mass(body, link.mass, link.centre, link.inertia)
            if b:
                body.joint.name = str(b)
                armature = max(link.armature, ARMATURE_S * link.damping)
                _set_joint(body.joint, link.joint, link.origin, link.axis, link.limits, link.damping, armature)
            links.append(body)
        rails[0].joint.type = "fixed"
        for body in rails:
            _set_mass(body, 1.0, np.zeros(3), np.eye(3))
        for body, axis, name in zip((rails[1], rails[2], links[0]), np.eye(3), _RAILS, strict=True):
            body.joint.name = name
            _set_joint(body.joint, JointType.PRISMATIC, IDENTITY_POSE, axis, (-10.0, 10.0), 0.0, HEAVY_KG)
        self._add([*rails, *links])
        return links[0].articulation

    def _shape_of_hull(self, corners: Floats, groups: list[int]) -> Any:
        shape = physx.PhysxCollisionShapeConvexMesh(np.asarray(corners, np.float32), [1, 1, 1], self._material)
        return self._filtered(shape, groups)

    def _filtered(self, shape: Any, groups: list[int]) -> Any:
        shape.set_collision_groups(groups)
        shape.min_patch_radius = self._patch_m
        return shape

    def _shape(self, piece: ConvexPiece, groups: list[int]) -> Any:
        if piece.kind == "hull":
            return self._shape_of_hull(piece.vertices, groups)
        size, pose = piece.size, _pose(piece.pose)
        if piece.kind == "box":
            shape: Any = physx.PhysxCollisionShapeBox(np.array(size) / 2, self._material)
        elif piece.kind == "sphere":
            shape = physx.PhysxCollisionShapeSphere(size[0], self._material)
        else:
            kind = physx.PhysxCollisionShapeCapsule if piece.kind == "capsule" else physx.PhysxCollisionShapeCylinder
            shape = kind(size[0], size[1] / 2, self._material)
            pose = pose * _X_TO_Z
        shape.local_pose = pose
        return self._filtered(shape, groups)


simulation = PhysxSimulation

_X_TO_Z: Final = sapien.Pose([0, 0, 0], [np.sqrt(0.5), 0, -np.sqrt(0.5), 0])  # round shapes lie along x in PhysX


def _pose(pose: Floats) -> Any:
    return sapien.Pose(np.asarray(pose[:3], np.float32), np.asarray(pose[3:], np.float32))


def _x_axis(axis: Floats) -> Any:
    """Return a pose whose x axis is a unit vector (3,)."""
    y = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    y /= np.linalg.norm(y)
    return _pose(np.array([0, 0, 0, *quat_from_matrix(np.column_stack([axis, y, np.cross(axis, y)]))]))


def _set_mass(body: Any, mass: float, centre: Floats, inertia: Floats) -> None:
    moments, axes = np.linalg.eigh(inertia)
    axes[:, 0] *= np.linalg.det(axes)
    body.mass = mass
    body.cmass_local_pose = _pose(np.concatenate([centre, quat_from_matrix(axes)]))
    body.inertia = moments
    body.max_depenetration_velocity = SEPARATION_M_S


def _set_joint(
    joint: Any,
    kind: JointType,
    origin: Floats,
    axis: Floats,
    limits: tuple[float, float],
    damping: float,
    armature: float,
) -> None:
    joint.type = "prismatic" if kind is JointType.PRISMATIC else "revolute"
    turn = _x_axis(axis)  # joints of PhysX move about or along x
    joint.pose_in_parent, joint.pose_in_child = _pose(origin) * turn, turn
    joint.limit = np.array([limits])
    joint.armature = np.array([armature])
    joint.friction = 0.0
    joint.set_drive_properties(0.0, damping)


def _cliques(pairs: Iterable[tuple[int, int]]) -> list[set[int]]:
    """Return sets of links in which all pairs are in `pairs`; together they have all pairs."""
    left, every, found = set(pairs), set(pairs), []
    while left:
        clique = set(min(left))
        for b in sorted({b for pair in every for b in pair}):
            if all((min(a, b), max(a, b)) in every for a in clique if a != b):
                clique.add(b)
        found.append(clique)
        left -= {(a, b) for a in clique for b in clique}
    return found
