"""An arm with a hand, and grasps that it can execute: inverse kinematics, limits, MuJoCo collisions.

The library mink solves inverse kinematics by differential steps, each a quadratic program within the joints' limits. An
arm that jumps between consecutive poses of the trajectory cannot execute the grasp."""

import pathlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from graspd.service.model.digests import digest_files
from graspd.service.model.errors import InputError
from graspd.service.model.states import AssetKind
from graspd.service.model.transforms import Floats, compose
from graspd.worker.engines.mujoco_warnings import ARENA
from graspd.worker.episodes.execution import Executions, Path, straight_paths
from graspd.worker.hands.collisions import collision_exempt_pairs
from graspd.worker.hands.load import HandSource, body_model, files_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.options import HandOptions
from graspd.worker.hands.robot import FREE, MOVING, joint_chain
from graspd.worker.hands.tree import build_tree
from graspd.worker.simulation.environment import Obstacle
from graspd.worker.validation.decomposition import ConvexPieces
from graspd.worker.validation.model import add_bodies, add_mesh, add_support


@dataclass(frozen=True)
class Arm:
    """The chain of an arm with all its links, except links below the mount."""

    model: HandModel  # bodies, joints, limits and convex pieces; it has no palm and no fingers
    mount: str
    mount_body: int
    mount_pose: Floats  # (7,) pose of the mount link in its body's frame
    hand_pose: Floats  # (7,) pose of the hand's root link in the mount link's frame

    def root_pose(self, body_pose: Floats) -> Floats:
        """Return poses (..., 7) of the hand's root link for poses of the body that carries the mount."""
        return compose(compose(body_pose, self.mount_pose), self.hand_pose)


def read_arm(path: str | pathlib.Path, mount: str, hand_pose: Floats) -> Arm:
    """Read an arm from a URDF, its folder or a ZIP, without links below the mount, such as a gripper.
    Joints that do not lead to the mount are fixed at zero, or at the nearest value inside their limits. Raises
    InputError: there is no link `mount`, or no joint moves it."""
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
    return Arm(model, mount, body, np.asarray(pose, float), hand_pose)


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


@dataclass
class ReachResult:
    """Grasps that an arm can execute."""

    rows: list[int] = field(default_factory=list)
    paths: list[list[Path]] = field(default_factory=list)
    """Their motions; joints are the arm's, then the hand's."""
    refused: Counter[str] = field(default_factory=Counter)
    """Number of grasps that the arm cannot execute, by reason."""
    candidates: int = 0


class ReachSearch:
    """Search for motions of one arm with one hand around one object. Not thread-safe.
    Raises InputError: mink is not installed."""

    def __init__(self, arm: Arm, base: Floats, found: Executions, pieces: ConvexPieces) -> None:
        try:
            import mink
        except ImportError:
            raise InputError("arms need mink; run pip install 'graspd[arm]'") from None
        self.arm, self.found = arm, found
        supports = () if found.placed is None else found.placed.supports
        self.world = ArmScene(arm, base, found.hand, pieces, supports)
        self._mink = mink
        self._model = arm_spec(arm, base).compile()
        self._configuration = mink.Configuration(self._model)
        self._task = mink.FrameTask(MOUNT, "site", position_cost=1.0, orientation_cost=0.3, lm_damping=1e-3)
        self._limits = [mink.ConfigurationLimit(self._model)]
        self._order = np.array([int(self._model.joint(f"arm{b}").qposadr[0]) for b in arm.model.joint_body], np.intp)

    def search_all(self, wanted: int = 0) -> ReachResult:
        """Search motions for all grasps in their order, or until `wanted` (if above 0) are executable."""
        reached = ReachResult()
        for row in range(len(self.found)):
            reached.candidates += 1
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
        long, short = (straight_paths(self.found, row, points) for points in (LONG, SHORT))
        ways = [a if a.phase in _LONG_PHASES else b for a, b in zip(long, short, strict=True)]
        rng, farthest, reason = np.random.default_rng(row), -1, ""
        arm = self.arm.model
        for start in range(STARTS):
            middle = 0.5 * (arm.lower + arm.upper)
            q = middle if start == 0 else rng.uniform(arm.lower, arm.upper)
            found, why = self._search_from(q, ways, row)
            if found is not None:
                return found, ""
            stage = next(k for k, one in enumerate(REASONS) if why.startswith(one))
            if stage > farthest:
                farthest, reason = stage, why
        return None, reason

    def _search_from(self, q: Floats, ways: list[Path], row: int) -> tuple[list[Path] | None, str]:
        approach, *others = ways
        arrived = self._solve(q, approach.hand_pose[-1], STEPS)
        if arrived is None:
            return None, REASONS[0]
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

    def _solve(self, q: Floats, root_pose: Floats, steps: int) -> Floats | None:
        """Return dofs (A,) within limits that reach a pose (7,) of the hand's root link; None if none do."""
        mink, configuration, task = self._mink, self._configuration, self._task
        full = np.zeros(self._model.nq)
        full[self._order] = self.arm.model.expand(q)
        configuration.update(full)
        rotation = mink.SO3(np.asarray(root_pose[3:], float))
        task.set_target(mink.SE3.from_rotation_and_translation(rotation, np.asarray(root_pose[:3], float)))
        for _ in range(steps):
            error = task.compute_error(configuration)
            if np.linalg.norm(error[:3]) < NEAR_M and np.linalg.norm(error[3:]) < NEAR_RAD:
                found, arm = self.arm.model.reduce(configuration.q[self._order]), self.arm.model
                return found if ((found >= arm.lower - 1e-6) & (found <= arm.upper + 1e-6)).all() else None
            try:
                velocity: Any = mink.solve_ik(
                    configuration, [task], 1.0, solver="daqp", damping=1e-6, limits=self._limits
                )
            except mink.NoSolutionFound:
                return None
            configuration.integrate_inplace(velocity, 1.0)
        return None

    def _collision(self, joined: list[Floats], ways: list[Path], row: int) -> str:
        """Return the first colliding pair of bodies on the trajectory; empty without collision."""
        rest = np.asarray(self.found.object_pose[row], float)
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
#: Only pairs with the arm are tested, because trajectories are already free of other collisions.
_ARM: Final = {"contype": 1, "conaffinity": 1}
_OTHER: Final = {"contype": 0, "conaffinity": 1}


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
    """The arm with its hand in its environment. Not thread-safe."""

    def __init__(
        self, arm: Arm, base: Floats, hand: HandModel, pieces: ConvexPieces, supports: Sequence[Obstacle]
    ) -> None:
        self.arm, self.hand = arm, hand
        self.spec = arm_spec(arm, base)
        flange = self.spec.body("flange")
        root = flange.add_body(name="hand0", pos=arm.hand_pose[:3], quat=arm.hand_pose[3:])
        add_bodies(self.spec, root, hand, _OTHER, ("hand",) * 3)
        thing = self.spec.worldbody.add_body(name="object", mocap=True)
        for k, corners in enumerate(pieces.vertices):
            add_mesh(self.spec, thing.add_geom(**_OTHER), corners, f"object{k}")
        for k, support in enumerate(supports):
            add_support(self.spec, self.spec.worldbody.add_geom(name=f"support{k}", **_OTHER), support)
        self.spec.add_exclude(bodyname1=f"arm{arm.mount_body}", bodyname2="hand0")
        self._exclude_permanent_contacts()
        self.model: Any = self.spec.compile()
        self.data: Any = mujoco.MjData(self.model)
        self.arm_qpos = _joint_addresses(self.model, arm.model, "arm")
        self.hand_qpos = _joint_addresses(self.model, hand, "hand")

    def first_collision(self, arm_joints: Floats, hand_joints: Floats, object_pose: Floats) -> str:
        """Return a colliding pair, or an empty text if there is none.
        The posture is given by arm dofs (A,), hand joints (J,) and object pose (7,)."""
        self._put(self.model, self.data, arm_joints, hand_joints)
        self.data.mocap_pos[0], self.data.mocap_quat[0] = object_pose[:3], object_pose[3:]
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_collision(self.model, self.data)
        for contact in self.data.contact:
            if contact.dist < 0:
                return " and ".join(self._geom_label(int(geom)) for geom in contact.geom)
        return ""

    def _geom_label(self, geom: int) -> str:
        body = self.model.body(int(self.model.geom_bodyid[geom])).name
        for prefix, names in (("arm", self.arm.model.body_names), ("hand", self.hand.body_names)):
            if body.startswith(prefix):
                return names[int(body.removeprefix(prefix))]
        return "an obstacle" if body == "world" else str(body)

    def _put(self, model: Any, data: Any, arm_joints: Floats, hand_joints: Floats) -> None:
        data.qpos[_joint_addresses(model, self.arm.model, "arm")] = self.arm.model.expand(arm_joints)
        data.qpos[_joint_addresses(model, self.hand, "hand")] = hand_joints

    def _exclude_permanent_contacts(self) -> None:
        """Exclude body pairs in contact in nearly all random postures, as in MoveIt's setup."""
        model = self.spec.compile()
        data, rng = mujoco.MjData(model), np.random.default_rng(0)
        arm, hand = self.arm.model, self.hand
        open_ = hand.expand(hand.preshape)
        data.mocap_pos[0] = [0, 0, 1e3]
        count = Counter[tuple[int, ...]]()
        for _ in range(SAMPLES):
            self._put(model, data, rng.uniform(arm.lower, arm.upper), open_)
            mujoco.mj_kinematics(model, data)
            mujoco.mj_collision(model, data)
            count.update({tuple(sorted(model.geom_bodyid[c.geom].tolist())) for c in data.contact if c.dist < 0})
        for (a, b), times in sorted(count.items()):
            # The first link turns at the base, inside a support. Any other link inside a support means a wrong base.
            if times >= ALWAYS * SAMPLES and (a or model.body(b).name == "arm1"):
                self.spec.add_exclude(bodyname1=model.body(a).name, bodyname2=model.body(b).name)


def _joint_addresses(model: Any, tree: HandModel, prefix: str) -> NDArray[np.intp]:
    return np.array([int(model.joint(f"{prefix}{b}").qposadr[0]) for b in tree.joint_body], np.intp)
