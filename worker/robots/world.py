"""Arm, hand, object and supports in MuJoCo, to see whether the arm runs into itself or into what stands around."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from service.model.transforms import Floats
from worker.engines.mujoco_warnings import ARENA
from worker.hands.model import HandModel, JointType
from worker.quality.referee.decomposition import ConvexPieces
from worker.quality.referee.model import add_shape
from worker.robots.arm import Arm
from worker.simulation.surroundings import Obstacle

#: Pairs of bodies that touch in this share of random postures cannot be apart: their hulls are larger than they are.
ALWAYS: Final = 0.95
SAMPLES: Final = 100
#: Name of the frame that carries the hand.
MOUNT: Final = "mount"
#: The arm meets everything; the hand, the object and supports meet the arm alone: the rest was looked at before.
_ARM: Final = {"contype": 1, "conaffinity": 1}
_OTHER: Final = {"contype": 0, "conaffinity": 1}


def arm_spec(arm: Arm, base: Floats) -> Any:
    """The arm alone, its base at a pose (7,), with a site `mount` where the hand's root link is."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.memory = ARENA
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)
    root = spec.worldbody.add_body(name="arm0", pos=base[:3], quat=base[3:])
    bodies = _add_tree(spec, root, arm.model, "arm", _ARM)
    frame = bodies[arm.mount_body].add_body(name="flange", pos=arm.mount_pose[:3], quat=arm.mount_pose[3:])
    frame.add_site(name=MOUNT, pos=arm.hand_pose[:3], quat=arm.hand_pose[3:])
    for a, b in sorted(arm.model.neighbours):
        spec.add_exclude(bodyname1=f"arm{a}", bodyname2=f"arm{b}")
    return spec


class World:
    """The arm with its hand among what stands around it. Not for several threads at once."""

    def __init__(
        self, arm: Arm, base: Floats, hand: HandModel, pieces: ConvexPieces, supports: Sequence[Obstacle]
    ) -> None:
        self.arm, self.hand = arm, hand
        self.spec = arm_spec(arm, base)
        flange = self.spec.body("flange")
        root = flange.add_body(name="hand0", pos=arm.hand_pose[:3], quat=arm.hand_pose[3:])
        _add_tree(self.spec, root, hand, "hand", _OTHER)
        thing = self.spec.worldbody.add_body(name="object", mocap=True)
        for k, corners in enumerate(pieces.vertices):
            _hull(self.spec, thing.add_geom(**_OTHER), corners, f"object{k}")
        self._add_supports(supports)
        self.spec.add_exclude(bodyname1=f"arm{arm.mount_body}", bodyname2="hand0")
        self._exclude_what_always_touches()
        self.model: Any = self.spec.compile()
        self.data: Any = mujoco.MjData(self.model)
        self.arm_qpos = _addresses(self.model, arm.model, "arm")
        self.hand_qpos = _addresses(self.model, hand, "hand")

    def touches(self, arm_joints: Floats, hand_joints: Floats, object_pose: Floats) -> str:
        """What runs into what at arm dofs (A,), hand joints (J,) and an object pose (7,); empty: nothing."""
        self._put(self.model, self.data, arm_joints, hand_joints)
        self.data.mocap_pos[0], self.data.mocap_quat[0] = object_pose[:3], object_pose[3:]
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_collision(self.model, self.data)
        for contact in self.data.contact:
            if contact.dist < 0:
                return " and ".join(self._told(int(geom)) for geom in contact.geom)
        return ""

    def qpos(self, arm_joints: Floats, hand_joints: Floats) -> Floats:
        """The model's coordinates."""
        found = np.zeros(self.model.nq)
        found[self.arm_qpos] = self.arm.model.expand(arm_joints)
        found[self.hand_qpos] = hand_joints
        return found

    def _told(self, geom: int) -> str:
        body = self.model.body(int(self.model.geom_bodyid[geom])).name
        for prefix, names in (("arm", self.arm.model.body_names), ("hand", self.hand.body_names)):
            if body.startswith(prefix):
                return names[int(body.removeprefix(prefix))]
        return "what stands there" if body == "world" else str(body)

    def _put(self, model: Any, data: Any, arm_joints: Floats, hand_joints: Floats) -> None:
        data.qpos[_addresses(model, self.arm.model, "arm")] = self.arm.model.expand(arm_joints)
        data.qpos[_addresses(model, self.hand, "hand")] = hand_joints

    def _add_supports(self, supports: Sequence[Obstacle]) -> None:
        for k, support in enumerate(supports):
            geom = self.spec.worldbody.add_geom(name=f"support{k}", **_OTHER)
            if len(support.corners):
                _hull(self.spec, geom, support.corners, f"support{k}")
                continue
            normal, offset = support.planes[0, :3], support.planes[0, 3]
            geom.type, geom.size, geom.pos = mujoco.mjtGeom.mjGEOM_PLANE, [0, 0, 0.1], offset * normal
            mujoco.mju_quatZ2Vec(geom.quat, normal)

    def _exclude_what_always_touches(self) -> None:
        """As MoveIt's setup does: pairs of bodies of arm and hand that touch in nearly all of many random postures."""
        model = self.spec.compile()
        data, rng = mujoco.MjData(model), np.random.default_rng(0)
        arm, hand = self.arm.model, self.hand
        open_ = hand.expand(hand.preshape)
        data.mocap_pos[0] = [0, 0, 1e3]
        count: dict[tuple[int, int], int] = {}
        for _ in range(SAMPLES):
            self._put(model, data, rng.uniform(arm.lower, arm.upper), open_)
            mujoco.mj_kinematics(model, data)
            mujoco.mj_collision(model, data)
            pairs = {tuple(sorted(model.geom_bodyid[c.geom].tolist())) for c in data.contact if c.dist < 0}
            for pair in pairs:
                count[pair] = count.get(pair, 0) + 1
        for (a, b), times in sorted(count.items()):
            # The first link turns where the base stands; any other that is always in a support says that the base is.
            if times >= ALWAYS * SAMPLES and (a or model.body(b).name == "arm1"):
                self.spec.add_exclude(bodyname1=model.body(a).name, bodyname2=model.body(b).name)


def _add_tree(spec: Any, root: Any, model: HandModel, prefix: str, contact: dict[str, int]) -> list[Any]:
    """Bodies with joints and shapes below `root`, which is body 0."""
    bodies = [root]
    for b in range(1, model.bodies):
        pose = model.origin[b]
        body = bodies[model.parent[b]].add_body(name=f"{prefix}{b}", pos=pose[:3], quat=pose[3:])
        turning = model.joint_type[b] == JointType.REVOLUTE
        d, m, shift = int(model.dof[b]), float(model.multiplier[b]), float(model.offset[b])
        ends = sorted((m * float(model.lower[d]) + shift, m * float(model.upper[d]) + shift))
        body.add_joint(
            name=f"{prefix}{b}",
            type=mujoco.mjtJoint.mjJNT_HINGE if turning else mujoco.mjtJoint.mjJNT_SLIDE,
            axis=model.axis[b],
            range=ends,
            limited=mujoco.mjtLimited.mjLIMITED_TRUE,
        )
        # Nothing is simulated: any mass will do.
        body.mass, body.inertia, body.ipos, body.explicitinertial = 1.0, np.full(3, 1e-2), np.zeros(3), True
        bodies.append(body)
    for k, piece in enumerate(model.pieces):
        add_shape(spec, bodies[piece.body].add_geom(**contact), piece, f"{prefix}_{k}")
    return bodies


def _hull(spec: Any, geom: Any, corners: Floats, name: str) -> None:
    mesh = spec.add_mesh(name=name)
    mesh.uservert = np.ascontiguousarray(corners, np.float32).ravel()
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
    geom.type, geom.meshname = mujoco.mjtGeom.mjGEOM_MESH, name


def _addresses(model: Any, tree: HandModel, prefix: str) -> NDArray[np.intp]:
    return np.array([int(model.joint(f"{prefix}{b}").qposadr[0]) for b in tree.joint_body], np.intp)
