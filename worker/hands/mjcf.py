"""Read a hand from MJCF with MuJoCo, which resolves defaults, classes, angles and inertias.

Bodies become links. Several joints of a body become a chain of joints with links between them. Elements that a hand
does not need, and files outside the upload, never reach MuJoCo: see `worker.objects.mjcf_source`."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, Final

import mujoco
import numpy as np

from graspd.service.model.errors import HandError
from graspd.service.model.transforms import IDENTITY_POSE, Floats, compose, invert
from graspd.worker.hands.mjcf_drives import Couplings, bodies_to_root, commanded_ranges, servo_parameters
from graspd.worker.hands.primitives import hull
from graspd.worker.hands.robot import UNLIMITED_M, Joint, Link, Robot, Shape, build_robot
from graspd.worker.hands.tree import joint_motion
from graspd.worker.objects.mjcf_source import HIDDEN_GROUP, compile_model, mesh_of_geom

_FREE, _HINGE, _SLIDE = (int(getattr(mujoco.mjtJoint, f"mjJNT_{kind}")) for kind in ("FREE", "HINGE", "SLIDE"))
#: Colour that MuJoCo gives to a geom without a stated colour; such a geom has its material's colour.
_UNSTATED_COLOUR: Final = np.array([0.5, 0.5, 0.5, 1.0])
#: Distance below which a joint's anchor is at its body's origin [m].
_AT_ORIGIN_M: Final = 1e-12


def read_mjcf(files: Mapping[str, bytes], main: str) -> Robot:
    """Read and check an MJCF model.
    Raises HandError: MuJoCo rejects the model, or it is no hand. LimitError: the model is larger than a hand."""
    model, _, notes = compile_model(files, main)
    reader = _Reader(model, main, notes)
    roots = reader.roots()
    if len(roots) == 1 and not reader.joints_of(roots[0]):
        reader.add_body(roots[0], "", IDENTITY_POSE)
    else:
        reader.links.append(Link("world", (), None))
        for body in roots:
            reader.add_body(body, "world", _pose(model.body_pos[body], model.body_quat[body]))
    return build_robot("", reader.links, reader.joints, reader.notes, main, "MJCF", reader.tendons)


class _Reader:
    """Converts a compiled model's bodies to links and joints."""

    def __init__(self, model: Any, main: str, notes: list[str]) -> None:
        self.model, self.main = model, main
        self.links: list[Link] = []
        self.joints: list[Joint] = []
        self._bare = not (model.geom_contype.any() or model.geom_conaffinity.any())
        coupled = Couplings(model, self.joint_name)
        self._mimics, self._faults = coupled.follows, coupled.faults
        self._servos = servo_parameters(model, self._mimics, {j for pulls in coupled.tendons.values() for j in pulls})
        self.tendons = {
            name: {self.joint_name(joint): pull for joint, pull in pulls.items()}
            for name, pulls in coupled.tendons.items()
        }
        self._commanded = commanded_ranges(model)
        self.notes = notes + coupled.notes

    def roots(self) -> list[int]:
        """Return the world's children with moving joints; its other children belong to the environment."""
        model = self.model
        joints = [(int(model.jnt_type[j]), int(model.jnt_bodyid[j])) for j in range(model.njnt)]
        moving = {bodies_to_root(model, body)[-1] for kind, body in joints if kind in (_HINGE, _SLIDE)}
        if not moving:
            raise HandError(f"{self.main}: no moving joint; a hand needs at least one hinge or slide joint")
        free = [self.body_name(body) for kind, body in joints if kind == _FREE and body in moving]
        self.notes += [f"{name!r} has a free joint, which is replaced by a fixed one" for name in free]
        return sorted(moving)

    def joints_of(self, body: int) -> list[int]:
        first, count = int(self.model.body_jntadr[body]), int(self.model.body_jntnum[body])
        return [j for j in range(first, first + count) if int(self.model.jnt_type[j]) != _FREE]

    def body_name(self, body: int) -> str:
        return str(self.model.body(body).name) or f"body_{body}"

    def joint_name(self, joint: int) -> str:
        return str(self.model.joint(joint).name) or f"{self.body_name(int(self.model.jnt_bodyid[joint]))}_joint_{joint}"

    def add_body(self, body: int, parent: str, pose: Floats) -> None:
        """Add a body at a (7,) pose on link `parent`, and all bodies below it.
        MuJoCo moves a body by its joints one after another, each about its own anchor in the body's frame."""
        stack = [(body, parent, pose)]
        while stack:
            body, parent, pose = stack.pop()
            name = self.body_name(body)
            at, frame = parent, pose
            own = self.joints_of(body)
            for number, joint in enumerate(own):
                anchor = np.asarray(self.model.jnt_pos[joint], float)
                there = np.concatenate([anchor, [1.0, 0, 0, 0]])
                last = number + 1 == len(own) and np.linalg.norm(anchor) < _AT_ORIGIN_M
                link = name if last else f"{name}:{self.joint_name(joint)}"
                self.joints.append(self._joint(joint, at, link, compose(frame, there)))
                if not last:
                    self.links.append(Link(link, (), None))
                at, frame = link, invert(there)
            if parent and at != name:
                self.joints.append(Joint(f"{name}:fixed", "fixed", at, name, frame))
            self.links.append(self._link(body, name))
            children = [c for c in range(self.model.nbody - 1, body, -1) if self.model.body_parentid[c] == body]
            stack += [(c, name, _pose(self.model.body_pos[c], self.model.body_quat[c])) for c in children]

    def _joint(self, joint: int, parent: str, child: str, origin: Floats) -> Joint:
        model, name = self.model, self.joint_name(joint)
        what = f"{self.main}: joint {name!r}"
        still = Joint(name, "fixed", parent, child, origin)
        if int(model.jnt_type[joint]) not in (_HINGE, _SLIDE):
            return replace(still, type="ball", fault=f"{what} is a ball joint; write it as three hinge joints")
        slides = int(model.jnt_type[joint]) == _SLIDE
        axis = np.asarray(model.jnt_axis[joint], float)
        moving = replace(still, type="prismatic" if slides else "revolute", axis=axis)
        # In the pose of the file, the joint has the value `ref`.
        origin = compose(origin, joint_motion(moving, -float(model.qpos0[model.jnt_qposadr[joint]])))
        follows = self._mimics.get(joint)
        if isinstance(follows, float):
            return replace(still, origin=compose(origin, joint_motion(moving, follows)))
        limited = bool(model.jnt_limited[joint])
        most = UNLIMITED_M if slides else math.pi
        lower, upper = map(float, model.jnt_range[joint]) if limited else (-most, most)
        fault = self._faults.get(joint, "")
        if not -4 * math.pi <= lower <= upper <= 4 * math.pi:
            fault = f"{what}: range {lower:g} .. {upper:g} is reversed or too large"
        effort, stiffness = self._servos.get(joint, (0.0, 0.0))
        least, largest = self._commanded.get(joint, (lower, upper))
        if max(lower, least) < min(upper, largest):
            limited, lower, upper = True, max(lower, least), min(upper, largest)
        return replace(
            moving,
            type=moving.type if limited or slides else "continuous",
            origin=origin,
            lower=lower,
            upper=upper,
            effort=effort,
            mimic=follows,
            stiffness=stiffness,
            armature=float(model.dof_armature[model.jnt_dofadr[joint]]),
            dry_friction=float(model.dof_frictionloss[model.jnt_dofadr[joint]]),
            fault=fault,
        )

    def _link(self, body: int, name: str) -> Link:
        model = self.model
        first, count = int(model.body_geomadr[body]), int(model.body_geomnum[body])
        geoms = range(first, first + count) if count else range(0)
        touching = [g for g in geoms if model.geom_contype[g] or model.geom_conaffinity[g]]
        # Some models define contacts only by pairs: then all geoms in the collision groups count.
        touching = touching or [g for g in geoms if self._bare and model.geom_group[g] >= HIDDEN_GROUP]
        shown = [g for g in geoms if g not in touching and model.geom_group[g] < HIDDEN_GROUP]
        shown = shown or [g for g in touching if model.geom_group[g] < HIDDEN_GROUP]
        mass = float(model.body_mass[body])
        return Link(
            name,
            tuple(shape for g in touching for shape in self._shape(g)),
            mass if mass > 1e-8 else None,
            tuple(replace(s, colour=colour) for g in shown if (colour := self._colour(g)) for s in self._shape(g)),
        )

    def _shape(self, geom: int) -> Iterator[Shape]:
        model = self.model
        pose, size = _pose(model.geom_pos[geom], model.geom_quat[geom]), [float(s) for s in model.geom_size[geom]]
        match mujoco.mjtGeom(int(model.geom_type[geom])):
            case mujoco.mjtGeom.mjGEOM_SPHERE:
                yield Shape("sphere", (size[0],), pose)
            case mujoco.mjtGeom.mjGEOM_CAPSULE:
                yield Shape("capsule", (size[0], 2 * size[1]), pose)
            case mujoco.mjtGeom.mjGEOM_CYLINDER:
                yield Shape("cylinder", (size[0], 2 * size[1]), pose)
            case mujoco.mjtGeom.mjGEOM_BOX:
                yield Shape("box", (2 * size[0], 2 * size[1], 2 * size[2]), pose)
            case mujoco.mjtGeom.mjGEOM_ELLIPSOID:
                yield Shape("mesh", (1.0, 1.0, 1.0), pose, mesh=_ellipsoid(np.array(size)))
            case mujoco.mjtGeom.mjGEOM_MESH:
                yield Shape("mesh", (1.0, 1.0, 1.0), pose, mesh=mesh_of_geom(model, geom))

    def _colour(self, geom: int) -> tuple[float, float, float] | None:
        rgba, material = self.model.geom_rgba[geom], int(self.model.geom_matid[geom])
        if material >= 0 and np.allclose(rgba, _UNSTATED_COLOUR):
            rgba = self.model.mat_rgba[material]
        return (float(rgba[0]), float(rgba[1]), float(rgba[2])) if rgba[3] > 0 else None


def _pose(position: Any, quaternion: Any) -> Floats:
    return np.concatenate([np.asarray(position, float), np.asarray(quaternion, float)])


def _ellipsoid(half: Floats) -> tuple[Floats, Any]:
    """Return the hull of 162 points on an ellipsoid with half axes `half` (3,)."""
    count = 162
    z = 1 - (2 * np.arange(count) + 1) / count
    turn = np.arange(count) * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - z**2)
    return hull(np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1) * half)
