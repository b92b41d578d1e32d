"""Drake on the CPU (Tedrake et al. 2019): lagged convex contact (Castro et al. 2023), 8 ms steps.

Contacts are hydroelastic patches on supports and with at most two drives. All others are one point per pair of shapes,
without torsional friction."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from typing import Any, Final

import numpy as np
from pydrake import geometry
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody import tree
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import (
    AddMultibodyPlantSceneGraph,
    ContactModel,
    CoulombFriction,
    DiscreteContactApproximation,
    ExternallyAppliedSpatialForce,
)
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from graspd.service.model.transforms import Floats
from graspd.worker.hands.jaws import MAX_DOFS
from graspd.worker.hands.model import ConvexPiece, JointType
from graspd.worker.simulation.environment import Obstacle
from graspd.worker.validation.engines.port import Drive, EngineModel, Link

logging.getLogger("drake").setLevel(logging.ERROR)  # it warns that half-spaces touch no deformable bodies

TIMESTEP_S: Final = 0.008
STIFFNESS: Final = 3e4  # of each body at its contacts [N/m]; a pair of bodies has half of it
#: Pressure at the deepest point of a shape, if it were pressed as deep [Pa], and edges of round shapes' meshes [m].
MODULUS: Final = 1e7
EDGE_M: Final = 0.005
DISSIPATION: Final = 50.0  # [s/m] (Hunt and Crossley 1975): no body bounces faster than 2 cm/s
#: Gain and damping of the six joints that carry the root: sliding [N/m, N s/m] and turning [N m/rad, N m s/rad].
ROOT_GAINS: Final = (tree.PdControllerGains(p=1e5, d=1e3), tree.PdControllerGains(p=1e3, d=10.0))
_ROOT_AXES: Final = ((0, 0), (0, 1), (0, 2), (1, 2), (1, 1), (1, 0))  # (turning, axis): x y z, then yaw, pitch, roll
_ORIGIN: Final = RigidTransform()


def limitations(model: EngineModel) -> list[str]:
    """Return what Drake cannot simulate in a model."""
    return ["dry friction of joints"] if any(link.dry_friction for link in model.links) else []


class DrakeSimulation:
    """One plant of Drake with a hand, an object and supports."""

    def __init__(self, model: EngineModel) -> None:
        builder = DiagramBuilder()
        plant, scene = AddMultibodyPlantSceneGraph(builder, TIMESTEP_S)
        self._plant = plant
        plant.SetUseSampledOutputPorts(False)  # positions and velocities are then the whole state
        plant.set_adjacent_bodies_collision_filters(False)
        plant.set_contact_model(ContactModel.kHydroelasticWithFallback)
        plant.set_discrete_contact_approximation(DiscreteContactApproximation.kLagged)
        plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
        plain, soft, rigid = (_surface(model.friction) for _ in range(3))
        geometry.AddCompliantHydroelasticProperties(EDGE_M, MODULUS, soft)
        geometry.AddRigidHydroelasticProperties(rigid)
        self._base = plant.AddFrame(tree.FixedOffsetFrame("base", plant.world_frame(), _ORIGIN))
        # Flat pads need areas: on a single point an object turns. With more drives, areas cost four times as much.
        self._links = self._add_hand(model, soft if len(model.drives) <= MAX_DOFS else plain)
        self._object = plant.AddRigidBody("object", _inertia(model.obj.mass, np.zeros(3), model.obj.inertia))
        for corners in model.obj.pieces:
            self._add_shape(self._object, soft, geometry.Convex(corners.T, "piece"))
        for support in model.supports:
            self._add_shape(plant.world_body(), rigid, *_support(support))
        manager = scene.collision_filter_manager()
        shapes = [geometry.GeometrySet(plant.GetCollisionGeometriesForBody(link)) for link in self._links]
        for a, b in model.ignored:
            manager.Apply(geometry.CollisionFilterDeclaration().ExcludeBetween(shapes[a], shapes[b]))
        plant.Finalize()
        self._diagram = builder.Build()
        self._simulator = Simulator(self._diagram)
        self._context = plant.GetMyMutableContextFromRoot(self._simulator.get_mutable_context())
        self._places = np.array([joint.position_start() for joint in self._joints], np.intp)
        self._columns = np.array([joint.velocity_start() for joint in self._joints], np.intp)
        self._tendons = [drive for drive in model.drives if not _is_simple(drive)]
        self._pulls = np.zeros((len(self._tendons), len(self._links)))
        for row, drive in enumerate(self._tendons):
            self._pulls[row, list(drive.joints)] = drive.coefficients
        self._gain = np.array([drive.gain for drive in self._tendons])
        self._effort = np.array([drive.effort for drive in self._tendons])
        self._diverged = False

    def reset(self, object_pose: Floats, root: Floats, joints: Floats) -> None:
        self._simulator.get_mutable_context().SetTime(0.0)
        self._simulator.Initialize()
        self._step, self._diverged = 0, False
        self._start = _transform(root)
        self._base.SetPoseInParentFrame(self._context, self._start)
        self._root = np.zeros(len(_ROOT_AXES))
        plant, context = self._plant, self._context
        positions = np.zeros(plant.num_positions())
        positions[self._places] = [*self._root, *joints[1:]]
        plant.SetPositions(context, positions)
        plant.SetFloatingBaseBodyPoseInWorldFrame(context, self._object, _transform(object_pose))
        plant.SetVelocities(context, np.zeros(plant.num_velocities()))

    def run(self, root: Floats, joints: Floats, force: Floats, seconds: float) -> int:
        plant, context = self._plant, self._context
        steps = round(seconds / TIMESTEP_S)
        pushed = ExternallyAppliedSpatialForce()
        pushed.body_index = self._object.index()
        pushed.F_Bq_W = SpatialForce(np.zeros(3), force)
        plant.get_applied_spatial_force_input_port().FixValue(context, [pushed])
        target, still = self._root_coordinates(root), np.zeros(len(joints) - 1)
        speed = (target - self._root) / seconds
        desired = plant.get_desired_state_input_port(self._object.model_instance())
        stride = 1 if self._tendons or speed.any() else steps
        for step in range(stride, steps + 1, stride):
            at = self._root + (target - self._root) * (step / steps)
            desired.FixValue(context, np.concatenate([at, joints[1:], speed, still]))
            if self._tendons:
                self._pull(joints)
            self._step += stride
            try:
                self._simulator.AdvanceTo(self._step * TIMESTEP_S)  # without Python's lock, unlike single events
            except RuntimeError:  # the solver does not converge
                self._diverged = True
                break
        self._root = target
        return steps

    def object_pose(self) -> Floats:
        if self._diverged:
            return np.full(7, np.nan)
        pose = self._plant.EvalBodyPoseInWorld(self._context, self._object)
        return np.concatenate([pose.translation(), pose.rotation().ToQuaternion().wxyz()])

    def save(self) -> Any:
        return self._plant.GetPositionsAndVelocities(self._context), self._root

    def restore(self, state: Any) -> None:
        self._diverged = False
        values, self._root = state
        self._plant.SetPositionsAndVelocities(self._context, values)

    def _root_coordinates(self, root: Floats) -> Floats:
        """Return positions (6,) of the joints that carry the root for its pose (7,)."""
        moved = self._start.inverse() @ _transform(root)
        turned = RollPitchYaw(moved.rotation())
        return np.array([*moved.translation(), turned.yaw_angle(), turned.pitch_angle(), turned.roll_angle()])

    def _pull(self, joints: Floats) -> None:
        """Apply the tendons' pulls; their explicit integration is stable because the joints are damped."""
        now = np.zeros(len(joints))
        now[1:] = self._plant.GetPositions(self._context)[self._places[len(_ROOT_AXES) :]]
        pull = np.clip(self._gain * (self._pulls @ (joints - now)), -self._effort, self._effort)
        forces = np.zeros(self._plant.num_velocities())
        forces[self._columns[len(_ROOT_AXES) :]] = (pull @ self._pulls)[1:]
        self._plant.get_applied_generalized_force_input_port().FixValue(self._context, forces)

    def _add_hand(self, model: EngineModel, surface: Any) -> list[Any]:
        """Add links and joints; the joints of `_joints` are six of the root, then one per link but the root."""
        plant = self._plant
        links = [
            plant.AddRigidBody(f"link{b}", _inertia(link.mass, link.centre, link.inertia))
            for b, link in enumerate(model.links)
        ]
        for link, body in zip(model.links, links, strict=True):
            for piece in link.pieces:
                self._add_shape(body, surface, *_shape(piece))
        self._joints = []
        parent = self._base
        for k, (turning, axis) in enumerate(_ROOT_AXES):
            last = k == len(_ROOT_AXES) - 1
            child = links[0] if last else plant.AddRigidBody(f"root{k}", tree.SpatialInertia.Zero())
            kind = tree.RevoluteJoint if turning else tree.PrismaticJoint
            joint = plant.AddJoint(kind(f"root{k}", parent, child.body_frame(), np.eye(3)[axis], damping=0.0))
            plant.AddJointActuator(joint.name(), joint).set_controller_gains(ROOT_GAINS[turning])
            self._joints.append(joint)
            parent = child.body_frame()
        drives = {drive.joints[0]: drive for drive in model.drives if _is_simple(drive)}
        moving = [self._add_joint(links, model.links[b], b, drives.get(b)) for b in range(1, len(links))]
        for pair in model.couplings:
            ends = moving[pair.follower - 1], moving[pair.leader - 1]
            plant.AddCouplerConstraint(*ends, pair.ratio, pair.offset)
        self._joints += moving
        return links

    def _add_joint(self, links: list[Any], link: Link, b: int, drive: Drive | None) -> Any:
        plant = self._plant
        frame = tree.FixedOffsetFrame(f"joint{b}", links[link.parent].body_frame(), _transform(link.origin))
        kind = tree.RevoluteJoint if link.joint is JointType.REVOLUTE else tree.PrismaticJoint
        frames = plant.AddFrame(frame), links[b].body_frame()
        joint = plant.AddJoint(kind(f"joint{b}", *frames, link.axis, *link.limits, link.damping))
        # Joints without a drive of their own have an actuator for the rotor's inertia, too.
        actuator = plant.AddJointActuator(f"joint{b}", joint, np.inf if drive is None else drive.effort)
        actuator.set_default_gear_ratio(1.0)
        actuator.set_default_rotor_inertia(link.armature)
        if drive is not None:
            actuator.set_controller_gains(tree.PdControllerGains(p=drive.gain, d=0.0))
        return joint

    def _add_shape(self, body: Any, surface: Any, shape: Any, pose: Any = _ORIGIN) -> None:
        """Add a shape; two shapes touch over an area if both are hydroelastic and one of them is soft."""
        name = f"shape{self._plant.num_collision_geometries()}"
        self._plant.RegisterCollisionGeometry(body, pose, shape, name, surface)


simulation = DrakeSimulation


def _is_simple(drive: Drive) -> bool:
    return drive.coefficients == (1.0,)


def _surface(friction: float) -> Any:
    surface, coulomb = geometry.ProximityProperties(), CoulombFriction(friction, friction)
    geometry.AddContactMaterial(
        dissipation=DISSIPATION, point_stiffness=STIFFNESS, friction=coulomb, properties=surface
    )
    return surface


def _transform(pose: Iterable[float]) -> Any:
    values = np.asarray(pose, float)
    return RigidTransform(Quaternion(values[3:] / np.linalg.norm(values[3:])), values[:3])


def _inertia(mass: float, centre: Floats, inertia: Floats) -> Any:
    moments, products = np.diag(inertia), inertia[[0, 0, 1], [1, 2, 2]]
    return tree.SpatialInertia.MakeFromCentralInertia(mass, centre, tree.RotationalInertia(*moments, *products))


def _shape(piece: ConvexPiece) -> tuple[Any, Any]:
    """Return a piece's shape and its pose in the link's frame."""
    if piece.kind == "hull":
        return geometry.Convex(piece.vertices.T, "piece"), _ORIGIN
    kinds = {"box": geometry.Box, "sphere": geometry.Sphere, "cylinder": geometry.Cylinder, "capsule": geometry.Capsule}
    return kinds[piece.kind](*piece.size), _transform(piece.pose)


def _support(support: Obstacle) -> tuple[Any, Any]:
    """Return a support's shape and its pose in the world."""
    if len(support.corners):
        return geometry.Convex(support.corners.T, "support"), _ORIGIN
    normal, offset = support.planes[0, :3], support.planes[0, 3]
    return geometry.HalfSpace(), geometry.HalfSpace.MakePose(normal, offset * normal)
