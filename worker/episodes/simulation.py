"""Execution of motions in MuJoCo: the validator's model of the hand with its drives, the object at its mass, an arm.

The world is the scene's frame. Gravity acts on object and neighbours; hand and arm are gravity-compensated. The robot
is commanded by float32 actions at the frames of an episode. Between frames, targets move evenly, root quaternions after
normalisation. Stored actions are the executed ones, so a replay with the same libraries is bit-identical."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import ArrayLike

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
from graspd.worker.validation.model import FreeBody, MujocoOptions, add_bodies, build_scene
from graspd.worker.validation.protocol import MAX_DISPLACEMENT_M, MAX_ROTATION

#: Error at which a drive of an arm has its effort limit [rad], [m], and inertia of the drive [kg m^2], [kg].
#: The drives are critically damped. MuJoCo Menagerie's arms have errors of 0.006 to 0.07 rad and 0.1 kg m^2.
DRIVE_RAD: Final = 0.02
DRIVE_M: Final = 0.002
ARMATURE: Final = 0.1
#: Largest displacement of the object before the hand closes [m]; a ball rolls by up to 7 mm from its rest pose.
TOUCHED_M: Final = 0.01
_CLOSE, _SQUEEZE = PHASES.index("close"), PHASES.index("squeeze")

#: Returns the action (D,) of a frame from its number, the state (D,) and the object's pose (7,).
Policy = Callable[[int, Floats, Floats], Floats]


class Simulation:
    """A robot in a scene of objects. Not thread-safe."""

    def __init__(
        self, robot: Robot, obj: ObjectModel, pieces: ConvexPieces, placed: PlacedGrasps, *, fps: float
    ) -> None:
        self.robot, self.placed, self.fps = robot, placed, fps
        self.steps = int(np.ceil(1 / (fps * MujocoOptions().timestep) - 1e-9))  # per frame
        physics = MujocoOptions(timestep=1 / (fps * self.steps))
        carrier = None if robot.arm is None else lambda spec: _add_arm(spec, robot, pieces, placed)
        scene = build_scene(robot.hand, obj, pieces, physics, placed.supports, placed.neighbours, carrier=carrier)
        self.scene, self.model = scene, scene.model
        self.data: Any = mujoco.MjData(self.model)
        self._split = len(robot.names) - robot.hand.dofs
        if robot.arm is None:
            self._carrier = np.arange(scene.root_qpos, scene.root_qpos + 7)
        else:
            joints = robot.arm.model.joint_body
            self._carrier = np.array([int(self.model.joint(f"arm{body}").qposadr[0]) for body in joints], np.intp)
        target = FreeBody(scene.object_body, scene.object_qpos, scene.centre, scene.mass)
        self._things = (target, *scene.neighbours)

    def execute(self, motion: Motion, row: int) -> Episode:
        """Execute the motion of the simulation's grasp `row`."""
        times = np.arange(int(motion.time[-1] * self.fps + 1e-9) + 1) / self.fps
        at = np.minimum(np.searchsorted(motion.time, times - 1e-9), len(motion.time) - 1)
        targets = as_float32(np.stack([np.interp(times, motion.time, column) for column in motion.targets.T], axis=1))
        actions, scene = np.concatenate([targets[1:], targets[-1:]]), int(self.placed.index[row])
        planned = Episode(row, scene, EpisodeOutcome.DIVERGED, motion.phase[at], targets[:1], actions)
        return self._run(planned)

    def replay(self, episode: Episode) -> Episode:
        """Execute the stored actions of an episode from its first state on."""
        if episode.outcome is EpisodeOutcome.DIVERGED:  # during the last action
            repeated = np.concatenate([episode.action, episode.action[-1:]])
            episode = replace(episode, action=repeated, phase=np.append(episode.phase, episode.phase[-1:]))
        return self._run(episode)

    def follow(self, policy: Policy, start: Episode) -> Episode:
        """Execute a policy from the first state of an episode on, for as many frames and with its phases."""
        return self._run(start, policy)

    def _run(self, planned: Episode, policy: Policy | None = None) -> Episode:
        """Execute all actions but the last one; after a numerical divergence there are fewer frames."""
        targets = np.concatenate([planned.state[:1], planned.action])
        controls = self._controls(targets)
        self._set_up(targets[0], controls[0], planned.scene)
        data, states, things = self.data, [targets[0]], [self._poses()]
        for frame in range(len(planned.action) - 1):
            if policy is not None:
                targets[frame + 1 :] = policy(frame, states[-1], things[-1][0])
                controls[frame + 1] = self._controls(targets[frame + 1 : frame + 2])[0]
            for share in np.arange(1, self.steps + 1) / self.steps:
                data.ctrl[:] = (1 - share) * controls[frame] + share * controls[frame + 1]
                if self.robot.arm is None:
                    pose = (1 - share) * targets[frame, :7] + share * targets[frame + 1, :7]
                    data.mocap_pos[0], data.mocap_quat[0] = pose[:3], pose[3:] / np.linalg.norm(pose[3:])
                mujoco.mj_step(self.model, data)
            if is_invalid(data):
                break
            states.append(self._state(states[-1]))
            things.append(self._poses())
        poses, kept = as_float32(things), slice(len(states))
        found = replace(
            planned,
            state=as_float32(states),
            object_pose=poses[:, 0],
            neighbour_pose=poses[:, 1:],
            phase=planned.phase[kept],
            action=targets[1:][kept],
            outcome=EpisodeOutcome.DIVERGED,
        )
        return found if len(states) < len(planned.action) else replace(found, outcome=self.outcome(found))

    def _set_up(self, start: Floats, controls: Floats, scene: int) -> None:
        data, carrier = self.data, start[: self._split].copy()
        mujoco.mj_resetData(self.model, data)
        data.qpos[self.scene.joint_qpos] = self.robot.hand.expand(start[self._split :])
        if self.robot.arm is None:
            carrier[3:] /= np.linalg.norm(carrier[3:])
            data.mocap_pos[0], data.mocap_quat[0] = carrier[:3], carrier[3:]
        else:
            carrier = self.robot.arm.model.expand(carrier)
        data.qpos[self._carrier], data.ctrl[:] = carrier, controls
        for thing, pose in zip(self._things, self._rest(scene), strict=True):
            data.qpos[thing.qpos : thing.qpos + 7] = [*apply(pose, thing.centre), *pose[3:]]
            data.xfrc_applied[thing.body, :3] = -ACCELERATION * thing.mass * UP

    def _rest(self, scene: int) -> Floats:
        """Return poses (1 + M, 7) of the object and its neighbours at rest."""
        beside = self.placed.neighbour_pose[scene] if self.placed.neighbours else np.zeros((0, 7))
        return np.concatenate([np.asarray(self.placed.object_pose, float)[scene][None], beside])

    def _poses(self) -> Floats:
        """Return present poses (1 + M, 7) of the object and its neighbours."""
        at = np.array([self.data.qpos[thing.qpos : thing.qpos + 7] for thing in self._things])
        at[:, :3] -= quat_rotate(at[:, 3:], np.array([thing.centre for thing in self._things]))
        return at

    def _controls(self, targets: Floats) -> Floats:
        """Return the controls (T, A) for targets (T, D)."""
        of_hand = self.scene.controls(self.robot.hand.expand(targets[:, self._split :]))
        arm = self.robot.arm
        return of_hand if arm is None else np.hstack([arm.model.expand(targets[:, : self._split]), of_hand])

    def _state(self, before: Floats) -> Floats:
        carrier = self.data.qpos[self._carrier]
        if self.robot.arm is not None:
            carrier = self.robot.arm.model.reduce(carrier)
        elif carrier[3:] @ before[3:7] < 0:
            carrier[3:] *= -1  # without jumps between frames
        return np.concatenate([carrier, self.robot.hand.reduce(self.data.qpos[self.scene.joint_qpos])])

    def outcome(self, episode: Episode) -> EpisodeOutcome:
        """Return the outcome of a complete episode by the rules of the lift test, from its frames alone."""
        rest, thing, centre = self._rest(episode.scene), episode.object_pose, self.scene.centre
        moved, turned = _motion(thing[episode.phase < _CLOSE], rest[0], centre)
        touched = bool((moved > TOUCHED_M).any() or (turned > MAX_ROTATION).any())
        for one, neighbour in enumerate(self.scene.neighbours):
            pose, at = episode.neighbour_pose[:, one], rest[1 + one]
            up = quat_rotate(pose[:, 3:], quat_rotate(quat_conjugate(at[3:]), UP))
            moved, _ = _motion(pose, at, neighbour.centre)
            touched |= bool((moved > NEIGHBOUR_MOVED_M).any() or (up @ UP < np.cos(NEIGHBOUR_TILTED)).any())
        if touched:
            return EpisodeOutcome.TOUCHED
        # The commanded state of a frame is the action of the frame before.
        last = np.flatnonzero(episode.phase <= _SQUEEZE)[-1]
        states = np.stack([episode.action[last - 1], episode.state[-1]])
        before, now = compose(invert(self.robot.poses(states)[0][1][:, 0]), np.stack([rest[0], thing[-1]]))
        moved, turned = _motion(now, before, centre)
        if moved < MAX_DISPLACEMENT_M and turned < MAX_ROTATION:
            return EpisodeOutcome.SUCCEEDED
        risen = (apply(thing, centre) - apply(rest[0], centre)) @ UP
        return EpisodeOutcome.DROPPED if risen.max() > MAX_DISPLACEMENT_M else EpisodeOutcome.NOT_LIFTED


def _motion(poses: Floats, start: Floats, centre: Floats) -> tuple[Floats, Floats]:
    """Return displacements (...) of a point [m] and rotations (...) [rad] of poses (..., 7) from another one (7,)."""
    turn = quat_multiply(quat_conjugate(start[3:]), poses[..., 3:])
    angle = 2 * np.arctan2(np.linalg.norm(turn[..., 1:], axis=-1), np.abs(turn[..., 0]))
    return np.linalg.norm(apply(poses, centre) - apply(start, centre), axis=-1), np.asarray(angle)


def as_float32(values: ArrayLike) -> Floats:
    """Return values as episodes store them, with the precision of float32."""
    return np.asarray(values, np.float32).astype(float)


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
