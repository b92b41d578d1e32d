"""Execution of motions in MuJoCo: the validator's model of the hand with its drives, the object at its mass, an arm.

The world is the scene's frame. Gravity acts on object and neighbours; hand and arm are gravity-compensated. The robot
is commanded by float32 actions at the frames of an episode. Between frames, targets move evenly, root quaternions after
normalisation. Stored actions are the executed ones, so a replay with the same libraries is bit-identical."""

from dataclasses import replace
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from graspd.service.model.matter import ACCELERATION
from graspd.service.model.transforms import Floats, apply, compose, invert, quat_conjugate, quat_multiply, quat_rotate
from graspd.worker.engines.mujoco_warnings import is_invalid
from graspd.worker.episodes.episode import PHASES, Episode, EpisodeOutcome, Robot
from graspd.worker.episodes.motion import Motion
from graspd.worker.episodes.reach import Arm, ArmScene
from graspd.worker.hands.model import Drag, JointType
from graspd.worker.objects.model import ObjectModel
from graspd.worker.simulation.environment import UP, PlacedGrasps
from graspd.worker.validation.decomposition import ConvexPieces
from graspd.worker.validation.lift import NEIGHBOUR_MOVED_M, NEIGHBOUR_TILTED
from graspd.worker.validation.model import MujocoOptions, Scene, add_bodies, build_scene
from graspd.worker.validation.protocol import MAX_DISPLACEMENT_M, MAX_ROTATION

#: Error at which a drive of an arm has its effort limit [rad], [m], and inertia of the drive [kg m^2], [kg].
#: The drives are critically damped. MuJoCo Menagerie's arms have errors of 0.006 to 0.07 rad and 0.1 kg m^2.
DRIVE_RAD: Final = 0.02
DRIVE_M: Final = 0.002
ARMATURE: Final = 0.1
#: Largest displacement of the object before the hand closes [m]; a ball rolls by up to 7 mm from its rest pose.
TOUCHED_M: Final = 0.01
_CLOSE, _SQUEEZE = PHASES.index("close"), PHASES.index("squeeze")


class Simulation:
    """A robot in a scene of objects. Not thread-safe."""

    def __init__(
        self, robot: Robot, obj: ObjectModel, pieces: ConvexPieces, placed: PlacedGrasps, *, fps: float
    ) -> None:
        self.robot, self.obj, self.placed, self.fps = robot, obj, placed, fps
        longest = MujocoOptions().timestep
        self.steps = int(np.ceil(1 / (fps * longest) - 1e-9))  # per frame
        physics = MujocoOptions(timestep=1 / (fps * self.steps))
        carrier = None if robot.arm is None else lambda spec: _add_arm(spec, robot, pieces, placed)
        self.scene: Scene = build_scene(
            robot.hand, obj, pieces, physics, placed.supports, placed.neighbours, carrier=carrier
        )
        model = self.scene.model
        self.data: Any = mujoco.MjData(model)
        tree = None if robot.arm is None else robot.arm.model
        names = () if tree is None else (f"arm{body}" for body in tree.joint_body)
        self._arm_qpos = np.array([int(model.joint(name).qposadr[0]) for name in names], np.intp)
        self._split = len(robot.names) - robot.hand.dofs

    def run(self, actions: Floats, start: Floats, scene: int) -> tuple[Floats, Floats, Floats]:
        """Execute actions (T, D) from a state (D,) on; return states (T, D) and poses of objects (T, 7), (T, M, 7).
        The last action is not executed. After a numerical divergence there are fewer frames."""
        self._set_up(start, scene)
        model, data = self.scene.model, self.data
        targets = np.concatenate([start[None], actions])
        controls, flying = self._controls(targets), self.robot.arm is None
        states, things, beside = [start], [self._object_pose()], [self._neighbour_poses()]
        for frame in range(len(actions) - 1):
            for share in np.arange(1, self.steps + 1) / self.steps:
                data.ctrl[:] = (1 - share) * controls[frame] + share * controls[frame + 1]
                if flying:
                    pose = (1 - share) * targets[frame, :7] + share * targets[frame + 1, :7]
                    data.mocap_pos[0], data.mocap_quat[0] = pose[:3], pose[3:] / np.linalg.norm(pose[3:])
                mujoco.mj_step(model, data)
            if is_invalid(data):
                break
            states.append(self._state(states[-1]))
            things.append(self._object_pose())
            beside.append(self._neighbour_poses())
        return as_float32(states), as_float32(things), as_float32(beside)

    def _set_up(self, start: Floats, scene: int) -> None:
        data, carrier = self.data, start[: self._split]
        mujoco.mj_resetData(self.scene.model, data)
        data.qpos[self.scene.joint_qpos] = self.robot.hand.expand(start[self._split :])
        if self.robot.arm is None:
            pose = np.concatenate([carrier[:3], carrier[3:] / np.linalg.norm(carrier[3:])])
            data.qpos[self.scene.root_qpos : self.scene.root_qpos + 7] = pose
            data.mocap_pos[0], data.mocap_quat[0] = pose[:3], pose[3:]
        else:
            data.qpos[self._arm_qpos] = self.robot.arm.model.expand(carrier)
        data.ctrl[:] = self._controls(start)
        rest = np.asarray(self.placed.object_pose[scene], float)
        bodies = [(self.scene.object_body, self.scene.object_qpos, self.scene.centre, self.scene.mass, rest)]
        for free, pose in zip(self.scene.neighbours, self._resting_neighbours(scene), strict=True):
            bodies.append((free.body, free.qpos, free.centre, free.mass, pose))
        for body, qpos, centre, mass, pose in bodies:
            data.qpos[qpos : qpos + 7] = [*apply(pose, centre), *pose[3:]]
            data.xfrc_applied[body, :3] = -ACCELERATION * mass * UP

    def _resting_neighbours(self, scene: int) -> Floats:
        return np.asarray(self.placed.neighbour_pose[scene], float) if self.placed.neighbours else np.zeros((0, 7))

    def _controls(self, targets: Floats) -> Floats:
        """Return the controls (..., A) for targets (..., D)."""
        of_hand = self.scene.controls(self.robot.hand.expand(targets[..., self._split :]))
        if self.robot.arm is None:
            return of_hand
        return np.concatenate([self.robot.arm.model.expand(targets[..., : self._split]), of_hand], axis=-1)

    def _state(self, before: Floats) -> Floats:
        qpos, root = self.data.qpos, self.scene.root_qpos
        if self.robot.arm is None:
            carrier = np.array(qpos[root : root + 7])
            if carrier[3:] @ before[3:7] < 0:
                carrier[3:] *= -1  # without jumps between frames
        else:
            carrier = self.robot.arm.model.reduce(qpos[self._arm_qpos])
        return np.concatenate([carrier, self.robot.hand.reduce(qpos[self.scene.joint_qpos])])

    def _object_pose(self) -> Floats:
        return _mesh_pose(self.data.qpos[self.scene.object_qpos :][:7], self.scene.centre)

    def _neighbour_poses(self) -> Floats:
        poses = [_mesh_pose(self.data.qpos[free.qpos :][:7], free.centre) for free in self.scene.neighbours]
        return np.array(poses).reshape(-1, 7)

    def execute(self, motion: Motion, row: int, shard_row: int) -> Episode:
        """Execute the motion of grasp `row` of the simulation's grasps, which has row `shard_row` in its shard."""
        phase, targets = sample_motion(motion, self.fps)
        actions = np.concatenate([targets[1:], targets[-1:]])
        nothing = np.zeros((0, 7))
        scene = int(self.placed.index[row])
        return self._record(Episode(shard_row, scene, EpisodeOutcome.SUCCEEDED, phase, targets[:1], actions, nothing))

    def replay(self, episode: Episode) -> Episode:
        """Execute the stored actions of an episode from its first state on."""
        if episode.outcome is EpisodeOutcome.DIVERGED:  # during the last action
            repeated = np.concatenate([episode.action, episode.action[-1:]])
            episode = replace(episode, action=repeated, phase=np.append(episode.phase, episode.phase[-1:]))
        return self._record(episode)

    def _record(self, planned: Episode) -> Episode:
        states, things, beside = self.run(planned.action, planned.state[0], planned.scene)
        kept = slice(len(states))
        found = replace(planned, state=states, object_pose=things, neighbour_pose=beside, phase=planned.phase[kept])
        if len(states) < len(planned.action):
            return replace(found, action=planned.action[kept], outcome=EpisodeOutcome.DIVERGED)
        return replace(found, outcome=self.outcome(found))

    def outcome(self, episode: Episode) -> EpisodeOutcome:
        """Return the outcome of a complete episode by the rules of the lift test, from its frames alone."""
        rest = np.asarray(self.placed.object_pose[episode.scene], float)
        centre, thing = self.obj.centre_of_mass, episode.object_pose
        early = thing[episode.phase < _CLOSE]
        far = np.linalg.norm(apply(early, centre) - apply(rest, centre), axis=-1)
        if (far > TOUCHED_M).any() or (_angles(early, rest) > MAX_ROTATION).any():
            return EpisodeOutcome.TOUCHED
        for one, at in enumerate(self._resting_neighbours(episode.scene)):
            pose, middle = episode.neighbour_pose[:, one], self.placed.neighbours[one].obj.centre_of_mass
            up = quat_rotate(pose[:, 3:], quat_rotate(quat_conjugate(at[3:]), UP))
            far = np.linalg.norm(apply(pose, middle) - apply(at, middle), axis=-1)
            if (far > NEIGHBOUR_MOVED_M).any() or (up @ UP < np.cos(NEIGHBOUR_TILTED)).any():
                return EpisodeOutcome.TOUCHED
        # The commanded state of a frame is the action of the frame before.
        last = np.flatnonzero(episode.phase <= _SQUEEZE)[-1]
        root = self._root_poses(np.stack([episode.action[last - 1], episode.state[-1]]))
        before, now = compose(invert(root[0]), rest), compose(invert(root[1]), thing[-1])
        moved = float(np.linalg.norm(apply(now, centre) - apply(before, centre)))
        if moved < MAX_DISPLACEMENT_M and float(_angles(now, before)) < MAX_ROTATION:
            return EpisodeOutcome.SUCCEEDED
        risen = (apply(thing, centre) - apply(rest, centre)) @ UP
        return EpisodeOutcome.DROPPED if risen.max() > MAX_DISPLACEMENT_M else EpisodeOutcome.NOT_LIFTED

    def _root_poses(self, states: Floats) -> Floats:
        """Return (T, 7) poses of the hand's root in states (T, D)."""
        return np.asarray(self.robot.poses(states)[0][1][:, 0])


def sample_motion(motion: Motion, fps: float) -> tuple[NDArray[np.uint8], Floats]:
    """Return phases (T,) and targets (T, D) of a motion at frames; quaternions have no jumps in sign."""
    times = np.arange(int(motion.time[-1] * fps + 1e-9) + 1) / fps
    at = np.minimum(np.searchsorted(motion.time, times - 1e-9), len(motion.time) - 1)
    targets = np.stack([np.interp(times, motion.time, column) for column in motion.targets.T], axis=1)
    return np.asarray(motion.phase)[at], as_float32(targets)


def as_float32(values: ArrayLike) -> Floats:
    """Return values as episodes store them, with the precision of float32."""
    return np.asarray(values, np.float32).astype(float)


def _mesh_pose(centre_pose: Floats, centre: Floats) -> Floats:
    """Return the pose (7,) of a mesh frame from that of the body's frame at its centre of mass."""
    turn = np.array(centre_pose[3:])
    return np.concatenate([centre_pose[:3] - quat_rotate(turn, centre), turn])


def _angles(poses: Floats, other: Floats) -> Floats:
    """Return angles (...) between poses (..., 7) and another one (7,) [rad]."""
    turn = quat_multiply(quat_conjugate(np.asarray(other)[3:]), poses[..., 3:])
    return np.asarray(2 * np.arctan2(np.linalg.norm(turn[..., 1:], axis=-1), np.abs(turn[..., 0])))


def _add_arm(spec: Any, robot: Robot, pieces: ConvexPieces, placed: PlacedGrasps) -> Any:
    """Add the arm with its drives; return the hand's root body on it."""
    arm: Arm = robot.arm  # type: ignore[assignment]
    tree = arm.model
    if tree.drag is None:
        tree = replace(tree, drag=Drag(np.full(tree.bodies, ARMATURE), np.zeros(tree.bodies)))
    root = spec.worldbody.add_body(name="arm0", pos=robot.base[:3], quat=robot.base[3:])
    bodies = add_bodies(spec, root, tree, {"condim": 3}, ("arm",) * 3)
    for body in tree.joint_body:
        dof, ratio = int(tree.dof[body]), abs(float(tree.multiplier[body]))
        effort = float(tree.effort[dof]) / ratio
        actuator = spec.add_actuator(name=f"arm{body}", target=f"arm{body}", trntype=mujoco.mjtTrn.mjTRN_JOINT)
        error = DRIVE_RAD if tree.joint_type[body] == JointType.REVOLUTE else DRIVE_M
        actuator.set_to_position(kp=effort / error, dampratio=1.0)
        actuator.forcerange, actuator.forcelimited = [-effort, effort], mujoco.mjtLimited.mjLIMITED_TRUE
    frame = compose(arm.mount_pose, arm.hand_pose)
    hand = bodies[arm.mount_body].add_body(name="body0", pos=frame[:3], quat=frame[3:])
    names = {"world": "supports"} | {f"hand{b}": f"body{b}" for b in range(robot.hand.bodies)}
    for pair in ArmScene(arm, robot.base, robot.hand, pieces, placed).spec.excludes:
        spec.add_exclude(
            bodyname1=names.get(pair.bodyname1, pair.bodyname1), bodyname2=names.get(pair.bodyname2, pair.bodyname2)
        )
    return hand
