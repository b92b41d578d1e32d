"""The lift test: the object rests in its scene; the hand closes, squeezes, lifts and holds it.

dexgraspbench: DexGraspBench's published tabletop test. From the pregrasp on, the object's weight acts down (published:
1 N). After the squeeze the hand rises 10 cm in 0.4 s, without a hold.
lift: the hand starts at its standoff and must touch nothing on its approach, except supports by fingertips as the scene
allows. It rises smoothly in 0.8 s and holds for 2 s, with early termination as at level standard. Neighbours are free
bodies on the table, which must not move by 2 cm or topple. The world frame of the simulation is the object frame at
rest."""

from dataclasses import dataclass
from enum import IntEnum
from itertools import pairwise
from typing import Any, Final

import mujoco
import numpy as np

from graspd.service.model.matter import ACCELERATION
from graspd.service.model.transforms import Floats, invert, quat_conjugate, quat_multiply, quat_rotate, slerp
from graspd.worker.engines.mujoco_warnings import is_invalid
from graspd.worker.grasps import GraspSet, Posture
from graspd.worker.simulation.environment import RISE_M, PlacedGrasps
from graspd.worker.validation.model import Scene, interpolate_postures
from graspd.worker.validation.protocol import MAX_PENETRATION_M, MAX_ROTATION, STAGE_S, STAGES, Outcome, Rollout, Test

#: Largest displacement [m] and tilt [rad] of a neighbour; rotation about the vertical is allowed.
NEIGHBOUR_MOVED_M: Final = 0.02
NEIGHBOUR_TILTED: Final = MAX_ROTATION
LOOKS: Final = 4  # number of postures checked between two waypoints of an approach
#: Largest penetration of the open hand into the object's convex pieces on its approach [m]. The pieces protrude by up
#: to this much from a surface that the hand does not touch. Supports are exact.
OVERHANG_M: Final = 0.002
#: Number of steps of the rise, their length [s], and the share of the rise after each step. The rise has minimum jerk
#: (Flash and Hogan, "The coordination of arm movements", 1985). For 10 cm in 0.8 s it reaches 0.9 m/s2; the published
#: test has 25 m/s2.
RISING: Final = 100
RISING_S: Final = 0.008
LOSSES: Final = 5  # steps of the rise between two checks for a lost object
SMOOTHLY: Final = np.asarray(np.polyval([6, -15, 10, 0, 0, 0], np.linspace(0, 1, RISING + 1)[1:]), float)


class LiftOutcome(IntEnum):
    NOT_TRIED = 0
    LIFTED = 1
    PENETRATION = 2
    TOUCHED_ON_THE_WAY = 3
    LOST_WHILE_CLOSING = 4
    NOT_LIFTED = 5
    TURNED = 6
    DIVERGED = 7
    NEIGHBOUR_MOVED = 8


@dataclass
class LiftResult:
    outcome: LiftOutcome = LiftOutcome.NOT_TRIED
    margin: float = 0.0
    """Larger ratio of final deviation in position or rotation to its limit; 0 if the hand did not rise."""
    steps: int = 0

    @property
    def success(self) -> bool:
        return self.outcome is LiftOutcome.LIFTED


class Lift(Test):
    """Lift tests of grasps in one scene with supports. Not thread-safe."""

    def __init__(self, scene: Scene, placed: PlacedGrasps) -> None:
        super().__init__(scene)
        self.placed = placed
        self._goal = np.zeros(3)
        self._in_hand = True
        self._beside = placed.relative_neighbour_poses(0)

    def dexgraspbench(self, grasps: GraspSet, row: int) -> LiftResult:  # type: ignore[override]
        """Run the published test: one check of the object's world pose, after the rise."""
        self._in_hand = False
        if (rollout := self._set_up_scene(grasps, row)).outcome is not LiftOutcome.NOT_TRIED:
            return rollout
        self._close(grasps, row)
        self._rise(grasps, row, np.arange(1, STAGES + 1) / STAGES, STAGE_S)
        return self._complete_result(rollout, self._validate(Rollout()))

    def lift(self, grasps: GraspSet, row: int) -> LiftResult:
        """Run the test from the standoff to the end of the hold, along `grasps.approach`."""
        self._in_hand = True
        if (rollout := self.check_approach(grasps, row)).outcome is not LiftOutcome.NOT_TRIED:
            return rollout
        if not self._close(grasps, row, give_up=True):
            rollout.outcome = LiftOutcome.DIVERGED if is_invalid(self.data) else LiftOutcome.LOST_WHILE_CLOSING
            rollout.steps = self._steps
            return rollout
        self._rise(grasps, row)
        if (outcome := self._validate(Rollout())) is Outcome.HELD:
            outcome = self._hold(Rollout())
        rollout = self._complete_result(rollout, outcome)
        if rollout.success and self._neighbours_moved():
            rollout.outcome = LiftOutcome.NEIGHBOUR_MOVED
        return rollout

    def check_approach(self, grasps: GraspSet, row: int) -> LiftResult:
        """Set up the grasp's scene; the outcome is NOT_TRIED if pregrasp and approach are free of contact."""
        rollout = self._set_up_scene(grasps, row)
        if rollout.outcome is LiftOutcome.NOT_TRIED and self._collides_on_approach(grasps, row):
            rollout.outcome = LiftOutcome.TOUCHED_ON_THE_WAY
        return rollout

    def _set_up_scene(self, grasps: GraspSet, row: int) -> LiftResult:
        """Set up the grasp's scene with all objects at rest; gravity acts on objects but not on the hand."""
        self._steps, number = 0, int(self.placed.index[row])
        self._scene_pose = invert(np.asarray(self.placed.object_pose[number], float))
        self._up = self.placed.scenes[number].up
        self._beside = self.placed.relative_neighbour_poses(number)
        self._goal = np.zeros(3)
        self._set_posture(grasps.pregrasp.hand_pose[row], grasps.pregrasp.joint_positions[row])
        mujoco.mj_forward(self.scene.model, self.data)
        rollout = LiftResult()
        if max(self.penetration()) > MAX_PENETRATION_M:
            rollout.outcome = LiftOutcome.PENETRATION
        return rollout

    def _set_posture(self, hand_pose: Floats, joints: Floats) -> None:
        self.scene.set_posture(self.data, hand_pose, joints)
        self.data.mocap_pos[1], self.data.mocap_quat[1] = self._scene_pose[:3], self._scene_pose[3:]
        self.data.xfrc_applied[self.scene.object_body, :3] = -self.scene.push_force * self._up
        for free, pose in zip(self.scene.neighbours, self._beside, strict=True):
            centre = pose[:3] + quat_rotate(pose[3:], free.centre)
            self.data.qpos[free.qpos : free.qpos + 7] = [*centre, *pose[3:]]
            self.data.xfrc_applied[free.body, :3] = -ACCELERATION * free.mass * self._up

    def _neighbours_moved(self) -> bool:
        for free, pose in zip(self.scene.neighbours, self._beside, strict=True):
            now = self.data.qpos[free.qpos : free.qpos + 7]
            moved = float(np.linalg.norm(now[:3] - pose[:3] - quat_rotate(pose[3:], free.centre)))
            standing = quat_rotate(now[3:], quat_rotate(quat_conjugate(pose[3:]), self._up))
            if moved > NEIGHBOUR_MOVED_M or float(standing @ self._up) < np.cos(NEIGHBOUR_TILTED):
                return True
        return False

    def _collides_on_approach(self, grasps: GraspSet, row: int) -> bool:
        """Check whether the open hand penetrates the object or a support on its approach."""
        assert grasps.approach is not None, "a lift needs the grasps' approach"
        assert grasps.coming is not None
        path, joints = grasps.approach[row], grasps.coming[row]
        shares = np.arange(LOOKS) / LOOKS
        for a, b in pairwise(path):
            for share in shares:
                pose = np.concatenate([(1 - share) * a[:3] + share * b[:3], slerp(a[3:], b[3:], float(share))])
                if self._in_contact(pose, joints):
                    return True
        wide, closed = Posture(path[-1:], joints[None]), grasps.pregrasp.take(slice(row, row + 1))
        return any(self._in_contact(*interpolate_postures(wide, closed, 0, float(share))) for share in shares)

    def _in_contact(self, hand_pose: Floats, joints: Floats) -> bool:
        self._set_posture(hand_pose, joints)
        mujoco.mj_kinematics(self.scene.model, self.data)
        mujoco.mj_collision(self.scene.model, self.data)
        contact = self.data.contact
        if not len(contact.dist):
            return False
        distance, geom = np.asarray(contact.dist), contact.geom
        ours, support = self.scene.hand_geoms[geom], self.scene.support_geoms[geom]
        of_hand = ours.any(axis=1) & ~ours.all(axis=1)
        on_support = of_hand & support.any(axis=1)
        tip = self.scene.tip_geoms[geom].any(axis=1)
        allowed = np.where(tip, self.scene.pressing[geom].max(axis=1), 0.0)
        return bool((distance < -allowed)[on_support].any() or (distance[of_hand & ~on_support] < -OVERHANG_M).any())

    def _rise(self, grasps: GraspSet, row: int, path: Floats = SMOOTHLY, step_s: float = RISING_S) -> None:
        """Raise the root by `RISE_M`; except at level dexgraspbench, stop as soon as the object is lost."""
        root = np.asarray(grasps.squeeze.hand_pose[row], float)
        self.scene.command(self.data, root, grasps.squeeze.joint_positions[row])
        for number, share in enumerate(path):
            self._goal = share * RISE_M * self._up
            self.data.mocap_pos[0] = root[:3] + self._goal
            self._run(step_s)
            if self._in_hand and number % LOSSES == 0 and self._is_dropped():
                break

    def _object_displacement(self) -> Floats:
        """Return the displacement (3,) of the object's frame from its commanded position [m]."""
        at, yielded = super()._object_displacement(), self._root_deviation()
        if yielded is not None:
            root, turn = yielded
            at = self.data.mocap_pos[0] + quat_rotate(quat_conjugate(turn), at - root)
        return np.asarray(at - self._goal)

    def _rotation(self) -> Floats:
        turned, yielded = super()._rotation(), self._root_deviation()
        return turned if yielded is None else quat_multiply(quat_conjugate(yielded[1]), turned)

    def _root_deviation(self) -> tuple[Floats, Floats] | None:
        """Return the root's position (3,) and its rotation (4,) relative to the command.
        None if the root is fixed, or motion is measured in the world. The protocol's weld yields by 10 degrees under a
        hammer; an object that follows this deviation has not moved in the hand."""
        at = self.scene.root_qpos
        if at < 0 or not self._in_hand:
            return None
        root = self.data.qpos[at : at + 7]
        return root[:3], quat_multiply(root[3:], quat_conjugate(self.data.mocap_quat[0]))

    def _complete_result(self, rollout: LiftResult, outcome: Outcome) -> LiftResult:
        rollout.steps, rollout.margin = self._steps, self._motion_excess()
        rollout.outcome = OUTCOMES[outcome]
        return rollout


OUTCOMES: Final[dict[Any, LiftOutcome]] = {
    Outcome.HELD: LiftOutcome.LIFTED,
    Outcome.DISPLACED: LiftOutcome.NOT_LIFTED,
    Outcome.ROTATED: LiftOutcome.TURNED,
    Outcome.DIVERGED: LiftOutcome.DIVERGED,
}
