"""An arm with a hand, and grasps that it can execute: inverse kinematics, limits, MuJoCo collisions.

Inverse kinematics is damped least squares (Wampler 1986) with MuJoCo's Jacobians; joints at their limits are held. An
arm that jumps between consecutive poses of the trajectory cannot execute the grasp."""

import math
import pathlib
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from importlib import resources
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from graspd.service.model.digests import digest_files
from graspd.service.model.errors import InputError, NotFoundError, did_you_mean
from graspd.service.model.states import AssetKind
from graspd.service.model.transforms import Floats, compose
from graspd.worker.engines.mujoco_warnings import ARENA
from graspd.worker.episodes.execution import Executions, Path, straight_paths
from graspd.worker.hands.collisions import collision_exempt_pairs
from graspd.worker.hands.load import HandSource, body_model, files_from_path
from graspd.worker.hands.model import HandModel, JointType
from graspd.worker.hands.options import HandOptions
from graspd.worker.hands.robot import FREE, MOVING, joint_chain
from graspd.worker.hands.tree import build_tree
from graspd.worker.simulation.environment import PlacedGrasps
from graspd.worker.validation.decomposition import ConvexPieces
from graspd.worker.validation.model import add_bodies, add_mesh, add_support, empty_spec


@dataclass(frozen=True)
class Arm:
    """The chain of an arm with all its links, except links below the mount."""

    model: HandModel  # bodies, joints, limits and convex pieces; it has no palm and no fingers
    mount: str
    mount_body: int
    mount_pose: Floats  # (7,) pose of the mount link in its body's frame
    hand_pose: Floats  # (7,) pose of the hand's root link in the mount link's frame
    home: Floats  # (A,) dofs at the start of an episode, and first start of inverse kinematics

    def root_pose(self, body_pose: Floats) -> Floats:
        """Return poses (..., 7) of the hand's root link for poses of the body that carries the mount."""
        return compose(compose(body_pose, self.mount_pose), self.hand_pose)


#: Home of each built-in arm, `service/builtin/arms`: the flange ahead of the base, pointing down [rad].
BUILTIN_ARMS: Final = {
    "franka": (0.0, -math.pi / 4, 0.0, -3 * math.pi / 4, 0.0, math.pi / 2, math.pi / 4),
    "ur10e": (math.pi, -2.2, 2.0, 0.2 - math.pi / 2, -math.pi / 2, 0.0),
}


def read_arm(path: str | pathlib.Path, mount: str | None, hand_pose: Floats) -> Arm:
    """Read a built-in arm, or a URDF, its folder or a ZIP, without links below the mount (grippers).
    Joints that do not lead to the mount are fixed at zero, or at the nearest value inside their limits. A built-in arm
    has the mount `flange`. Raises InputError: there is no such arm, no link `mount`, or no joint moves it."""
    builtin = BUILTIN_ARMS.get(str(path))
    if builtin is not None:
        mount = mount or "flange"
        path = pathlib.Path(str(resources.files("graspd.service"))) / "builtin" / "arms" / f"{path}.urdf"
    elif not pathlib.Path(path).exists():
        meant = did_you_mean(str(path), BUILTIN_ARMS)
        raise NotFoundError(f"{path} is neither a file nor a built-in arm ({', '.join(BUILTIN_ARMS)}){meant}")
    if not mount:
        raise InputError("an arm needs the link that the hand is mounted on: --mount LINK")
    name, files, stated = files_from_path(path)
    source = HandSource.read(files, stated, name=name, digest=digest_files(AssetKind.HAND, files))
    robot = source.robot
    if mount not in robot.links:
        near = ", ".join(list(robot.links)[-6:])
        raise InputError(f"the arm {name} has no link {mount[:80]!r} to mount a hand on; its last links: {near}")
    chain = {joint.name: joint.type for joint in joint_chain(robot, mount)}
    moving = {name for name, kind in chain.items() if kind in MOVING}
    if not moving:
        raise InputError(f"no joint of the arm {name} moves the link {mount!r}; name the link behind its last joint")
    chosen = HandOptions(
        file=source.main,
        xacro=source.options.xacro,
        root=robot.root,
        drop=tuple(joint.child for joint in robot.joints.values() if joint.parent == mount),
        fix={
            joint.name: float(np.clip(0.0, joint.lower, joint.upper))
            for joint in robot.joints.values()
            if joint.name not in moving and joint.type != "fixed" and (joint.name not in chain or joint.type in FREE)
        },
    )
    tree = build_tree(robot, chosen)
    model = body_model(replace(source, options=chosen), tree)
    model = replace(model, neighbours=collision_exempt_pairs(model))
    body, pose = tree.links[mount]
    home = 0.5 * (model.lower + model.upper) if builtin is None else np.array(builtin)
    return Arm(model, mount, body, np.asarray(pose, float), hand_pose, home)


@dataclass(frozen=True)
class HandDescription:
    """Links and joints of a hand."""

    links: Mapping[str, tuple[int, Floats]]
    """Each link below the root: its body, and its pose (7,) in the body's frame."""
    mimics: frozenset[str]
    """Joints that the description couples to others; its readers move these joints themselves."""


def read_description(files: Mapping[str, bytes], options: Mapping[str, Any] | None = None) -> HandDescription:
    """Return links and couplings of a hand; `files` and `options` as in `load_hand`."""
    source = HandSource.read(files, options)
    robot, tree = source.robot, build_tree(source.robot, source.options)
    return HandDescription(
        dict(tree.links), frozenset(name for name in tree.joint_names if robot.joints[name].mimic is not None)
    )


#: Tolerance of the hand's pose [m, rad].
NEAR_M: Final = 1e-4
NEAR_RAD: Final = 1e-3
#: Number of the arm's start postures for a grasp, and of solver steps from each.
STARTS: Final = 24
STEPS: Final = 80
#: Largest motion of a joint between consecutive points of the trajectory, 5 mm apart [rad or m].
JUMP: Final = 0.25
#: Number of points of each motion of `_LONG_PHASES`, and of each other motion, which mainly moves the fingers.
LONG: Final = 21
SHORT: Final = 5
_LONG_PHASES: Final = ("approach", "lift")
#: Reasons why an arm cannot execute a grasp.
REASONS: Final = ("out of reach", "no continuous motion", "collision")
#: Damping of inverse kinematics, of squared errors [m^2], and largest step of a dof [rad or m].
DAMPING: Final = 0.1
LARGEST_STEP: Final = 0.5
_WEIGHTS: Final = np.array([1.0, 1.0, 1.0, 0.3, 0.3, 0.3])  # of errors [m] and [rad]


def reason_stage(reason: str) -> int:
    """Return the index in `REASONS` of a reason, which may name bodies after it; -1 for none."""
    return next((k for k, one in enumerate(REASONS) if reason.startswith(one)), -1)


@dataclass
class ReachResult:
    """Grasps that an arm can execute."""

    rows: list[int] = field(default_factory=list)
    paths: list[list[Path]] = field(default_factory=list)
    """Their motions; joints are the arm's, then the hand's."""
    refused: Counter[str] = field(default_factory=Counter)
    """Number of grasps that the arm cannot execute, by reason."""

    @property
    def candidates(self) -> int:
        return len(self.rows) + self.refused.total()


class ReachSearch:
    """Search for motions of one arm with one hand around one object. Not thread-safe."""

    def __init__(self, arm: Arm, base: Floats, found: Executions, pieces: ConvexPieces) -> None:
        self.arm, self.found = arm, found
        self.world = ArmScene(arm, base, found.hand, pieces, found.placed)
        self._model = arm_spec(arm, base).compile()
        self._data = mujoco.MjData(self._model)
        self._order = _joint_addresses(self._model, arm.model, "arm")
        tree = arm.model
        self._drives = np.zeros((self._model.nv, tree.dofs))  # velocity of each joint per dof
        self._drives[self._order, tree.dof[tree.joint_body]] = tree.multiplier[tree.joint_body]
        turns = tree.joint_type[tree.joint_body[tree.first_joint]] == JointType.REVOLUTE
        self._around = np.where(turns, 2 * np.pi, np.inf)

    def search_all(self, wanted: int = 0) -> ReachResult:
        """Search motions for all grasps in their order, or until `wanted` (if above 0) are executable."""
        reached = ReachResult()
        for row in range(len(self.found)):
            paths, reason = self.search_row(row)
            if paths is None:
                reached.refused[reason] += 1
            else:
                reached.rows.append(row)
                reached.paths.append(paths)
            if wanted and len(reached.rows) >= wanted:
                break
        return reached

    def search_row(self, row: int) -> tuple[list[Path] | None, str]:
        """Return the motions of one grasp, or None and the reason of the start that came farthest."""
        reason = ""
        for found, why in self.attempts(row):
            if found is not None:
                return found, ""
            reason = max(reason, why, key=reason_stage)
        return None, reason

    def attempts(self, row: int) -> Iterator[tuple[list[Path] | None, str]]:
        """Yield the motions of a grasp, or None and the reason, from `STARTS` postures; the first is home."""
        long, short = (straight_paths(self.found, row, points) for points in (LONG, SHORT))
        ways = [a if a.phase in _LONG_PHASES else b for a, b in zip(long, short, strict=True)]
        rng, arm = np.random.default_rng(int(self.found.rows[row])), self.arm.model
        low, high = (np.clip(self.arm.home + side * np.pi, arm.lower, arm.upper) for side in (-1, 1))
        for start in range(STARTS):
            yield self._search_from(self.arm.home if start == 0 else rng.uniform(low, high), ways, row)

    def _search_from(self, q: Floats, ways: list[Path], row: int) -> tuple[list[Path] | None, str]:
        approach, *others = ways
        arrived = self._solve(q, approach.hand_pose[-1], STEPS)
        if arrived is None:
            return None, REASONS[0]
        arrived = self._unwound(arrived)
        back = self._follow(arrived, approach.hand_pose[::-1])
        if back is None:
            return None, REASONS[1]
        joined, at = [back[::-1]], arrived
        for path in others:
            onward = self._follow(at, path.hand_pose)
            if onward is None:
                return None, REASONS[1]
            joined.append(onward)
            at = onward[-1]
        if pair := self._collision(joined, ways, row):
            return None, f"{REASONS[2]} of {pair}"
        return [
            replace(path, joints=np.concatenate([self.arm.model.expand(arm), path.joints], axis=1))
            for path, arm in zip(ways, joined, strict=True)
        ], ""

    def _follow(self, q: Floats, poses: Floats) -> Floats | None:
        """Return (M, A) dofs along root poses (M, 7) of the hand, from q on; None after a jump or failure."""
        rows = [q]
        for pose in poses[1:]:
            onward = self._solve(rows[-1], pose, STEPS // 4)
            if onward is None or np.abs(onward - rows[-1]).max() > JUMP:
                return None
            rows.append(onward)
        return np.array(rows)

    def _unwound(self, q: Floats) -> Floats:
        """Return dofs with as few whole turns from home as limits allow."""
        arm, turns = self.arm.model, np.rint((q - self.arm.home) / self._around)
        near = q - np.where(turns == 0, 0.0, turns * self._around)
        return np.where((near >= arm.lower) & (near <= arm.upper), near, q)

    def _solve(self, q: Floats, root_pose: Floats, steps: int) -> Floats | None:
        """Return dofs (A,) within limits that reach a pose (7,) of the hand's root link; None if none do."""
        model, data, arm = self._model, self._data, self.arm.model
        jacobian, error = np.zeros((6, model.nv)), np.zeros(6)
        at, turn, away = np.zeros(4), np.zeros(4), np.array(root_pose[3:], float)
        for _ in range(steps):
            data.qpos[self._order] = arm.expand(q)
            mujoco.mj_kinematics(model, data)
            error[:3] = root_pose[:3] - data.site_xpos[0]
            mujoco.mju_mat2Quat(at, data.site_xmat[0])
            mujoco.mju_mulQuat(turn, away, [at[0], *-at[1:]])
            mujoco.mju_quat2Vel(error[3:], turn, 1.0)
            if np.linalg.norm(error[:3]) < NEAR_M and np.linalg.norm(error[3:]) < NEAR_RAD:
                return q
            mujoco.mj_comPos(model, data)
            mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], 0)
            q = np.clip(q + self._step(q, jacobian @ self._drives, error), arm.lower, arm.upper)
        return None

    def _step(self, q: Floats, jacobian: Floats, error: Floats) -> Floats:
        """Return the damped least-squares step (A,) of dofs; dofs that it would press against a limit stay."""
        J, wanted = _WEIGHTS[:, None] * jacobian, _WEIGHTS * error
        pull = J.T @ wanted
        J = J * ~((q <= self.arm.model.lower) & (pull < 0) | (q >= self.arm.model.upper) & (pull > 0))
        damping = DAMPING * (1e-3 + min(float(wanted @ wanted), 1.0))
        step = J.T @ np.linalg.solve(J @ J.T + damping * np.eye(6), wanted)
        return np.asarray(step * min(1.0, LARGEST_STEP / max(float(np.abs(step).max()), 1e-9)))

    def _collision(self, joined: list[Floats], ways: list[Path], row: int) -> str:
        """Return the first pair with the arm that collides on the trajectory; else an empty text."""
        rest = np.asarray(self.found.object_pose[row], float)
        self.world.place_neighbours(row)
        for arm, path in zip(joined, ways, strict=True):
            for q, joints, pose in zip(arm, path.joints, path.hand_pose, strict=True):
                at = rest.copy()
                if path.phase == "lift":
                    at[:3] += pose[:3] - path.hand_pose[0, :3]
                if pair := self.world.first_collision(q, joints, at):
                    return pair
        return ""


#: Share of random postures from which on a pair in contact is excluded, because hulls exceed their meshes.
ALWAYS: Final = 0.95
SAMPLES: Final = 100
MOUNT: Final = "mount"  # name of the frame that carries the hand
#: Pairs with the arm are tested on the whole motion; trajectories near the object are free of other collisions.
_ARM: Final = {"contype": 1, "conaffinity": 1}
_OTHER: Final = {"contype": 0, "conaffinity": 1}
_WHOLE: Final = 2  # bit of pairs of hand and surroundings, tested on the transit only


def arm_spec(arm: Arm, base: Floats) -> Any:
    """Return the arm alone, its base at a pose (7,), with a site `mount` at the hand's root link."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.memory = ARENA
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)
    root = spec.worldbody.add_body(name="arm0", pos=base[:3], quat=base[3:])
    bodies = add_bodies(spec, root, arm.model, _ARM, ("arm",) * 3)
    frame = bodies[arm.mount_body].add_body(name="flange", pos=arm.mount_pose[:3], quat=arm.mount_pose[3:])
    frame.add_site(name=MOUNT, pos=arm.hand_pose[:3], quat=arm.hand_pose[3:])
    for a, b in sorted(arm.model.neighbours):
        spec.add_exclude(bodyname1=f"arm{a}", bodyname2=f"arm{b}")
    return spec


class ArmScene:
    """A hand, carried by an arm or flying, with its object, supports and neighbours. Not thread-safe."""

    def __init__(
        self, arm: Arm | None, base: Floats, hand: HandModel, pieces: ConvexPieces, placed: PlacedGrasps | None
    ) -> None:
        self.arm, self.hand, self.placed = arm, hand, placed
        if arm is None:
            self.spec = empty_spec(0.004)
            root = self.spec.worldbody.add_body(name="hand0", mocap=True)
        else:
            self.spec = arm_spec(arm, base)
            root = self.spec.body("flange").add_body(name="hand0", pos=arm.hand_pose[:3], quat=arm.hand_pose[3:])
            self.spec.add_exclude(bodyname1=f"arm{arm.mount_body}", bodyname2="hand0")
        add_bodies(self.spec, root, hand, _OTHER, ("hand",) * 3)
        beside = () if placed is None else placed.neighbours
        for name, solids in (("object", pieces.vertices), *((f"neighbour{k}", n.pieces) for k, n in enumerate(beside))):
            thing = self.spec.worldbody.add_body(name=name, mocap=True)
            for k, corners in enumerate(solids):
                add_mesh(self.spec, thing.add_geom(**_OTHER), corners, f"{name}{k}")
        for k, support in enumerate(() if placed is None else placed.supports):
            add_support(self.spec, self.spec.worldbody.add_geom(name=f"support{k}", **_OTHER), support)
        if arm is not None:
            self._exclude_permanent_contacts(arm)
        self.model: Any = self.spec.compile()
        self.data: Any = mujoco.MjData(self.model)
        self.arm_qpos = np.zeros(0, np.intp) if arm is None else _joint_addresses(self.model, arm.model, "arm")
        self.hand_qpos = _joint_addresses(self.model, hand, "hand")
        self._object = int(self.model.body("object").mocapid[0])
        names = [self.model.body(b).name for b in range(self.model.nbody)]
        self._hand = np.array([name.startswith("hand") for name in names])
        self._around = np.array([name in ("object", "world") or name.startswith("neighbour") for name in names])
        self.model.geom_conaffinity[self._around[self.model.geom_bodyid]] |= _WHOLE
        self.model.body_conaffinity[self._around] |= _WHOLE

    def place_neighbours(self, row: int) -> None:
        """Place the neighbours of a grasp's scene, before collisions of that grasp are tested."""
        if self.placed is not None and self.placed.neighbours:
            poses = np.asarray(self.placed.neighbour_pose[self.placed.index[row]], float)
            first = self._object + 1
            self.data.mocap_pos[first:], self.data.mocap_quat[first:] = poses[:, :3], poses[:, 3:]

    def first_collision(
        self, carrier: Floats, hand_joints: Floats, object_pose: Floats, *, clearance: float | None = None
    ) -> str:
        """Return a colliding pair, or an empty text if there is none.
        The posture is given by arm dofs (A,) or root pose (7,), hand joints (J,) and object pose (7,). With a
        `clearance` [m], hand and arm must have it from their surroundings; else only contacts of the arm count."""
        hand, around, margin = self._hand, self._around, clearance or 0.0
        self.model.geom_contype[hand[self.model.geom_bodyid]] = self.model.body_contype[hand] = _WHOLE * (
            clearance is not None
        )
        self.model.geom_margin[around[self.model.geom_bodyid]] = self.model.body_margin[around] = margin
        self._put(self.model, self.data, carrier, hand_joints)
        self.data.mocap_pos[self._object], self.data.mocap_quat[self._object] = object_pose[:3], object_pose[3:]
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_collision(self.model, self.data)
        for contact in self.data.contact:
            if contact.dist < margin:
                return " and ".join(self._geom_label(int(geom)) for geom in contact.geom)
        return ""

    def _geom_label(self, geom: int) -> str:
        body = self.model.body(int(self.model.geom_bodyid[geom])).name
        for prefix, tree in (("arm", self.hand if self.arm is None else self.arm.model), ("hand", self.hand)):
            if body.startswith(prefix):
                return tree.body_names[int(body.removeprefix(prefix))]
        return "an obstacle" if body == "world" else str(body)

    def _put(self, model: Any, data: Any, carrier: Floats, hand_joints: Floats) -> None:
        if self.arm is None:
            data.mocap_pos[0], data.mocap_quat[0] = carrier[:3], carrier[3:]
        else:
            data.qpos[_joint_addresses(model, self.arm.model, "arm")] = self.arm.model.expand(carrier)
        data.qpos[_joint_addresses(model, self.hand, "hand")] = hand_joints

    def _exclude_permanent_contacts(self, arm: Arm) -> None:
        """Exclude body pairs in contact in nearly all random postures, as in MoveIt's setup."""
        model = self.spec.compile()
        data, rng = mujoco.MjData(model), np.random.default_rng(0)
        low, high, open_ = arm.model.lower, arm.model.upper, self.hand.expand(self.hand.preshape)
        data.mocap_pos[:] = [0, 0, 1e3]
        count = Counter[tuple[int, ...]]()
        for _ in range(SAMPLES):
            self._put(model, data, rng.uniform(low, high), open_)
            mujoco.mj_kinematics(model, data)
            mujoco.mj_collision(model, data)
            count.update({tuple(sorted(model.geom_bodyid[c.geom].tolist())) for c in data.contact if c.dist < 0})
        for (a, b), times in sorted(count.items()):
            # The first link turns at the base, inside a support. Any other link inside a support means a wrong base.
            if times >= ALWAYS * SAMPLES and (a or model.body(b).name == "arm1"):
                self.spec.add_exclude(bodyname1=model.body(a).name, bodyname2=model.body(b).name)


def _joint_addresses(model: Any, tree: HandModel, prefix: str) -> NDArray[np.intp]:
    return np.array([int(model.joint(f"{prefix}{b}").qposadr[0]) for b in tree.joint_body], np.intp)
