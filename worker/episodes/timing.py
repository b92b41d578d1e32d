"""Timing of paths within limits of velocity and acceleration, each from rest to rest.

A path is a cubic B-spline, whose second derivative is continuous; its timing is minimum jerk (Flash and Hogan 1985).
Jerk is finite: on a straight path of length d in time T it is at most 60 d / T^3."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from graspd.service.model.transforms import Floats
from graspd.worker.episodes.episode import Robot
from graspd.worker.episodes.execution import minimum_jerk, velocity_limits
from graspd.worker.hands.model import HandModel, JointType

#: Acceleration limits of joints [rad/s^2], [m/s^2]; descriptions do not state them. An arm's is the least that is
#: published for Franka's Panda.
ARM_ACCELERATION: Final = (7.5, 2.0)
FINGER_ACCELERATION: Final = (50.0, 2.0)
#: Limits of a flying hand's root: velocity [m/s], [rad/s] and acceleration [m/s^2], [rad/s^2].
FLYING_VELOCITY: Final = (1.0, 3.0)
FLYING_ACCELERATION: Final = (5.0, 20.0)
_FINE: Final = np.linspace(0.0, 1.0, 401)  # times at which limits are tested, of a duration of 1 s


@dataclass(frozen=True)
class MotionLimits:
    """Limits of a robot's state (D,). A flying root has two: of its position and of its rotation."""

    velocity: Floats  # (L,) [m/s or rad/s]
    acceleration: Floats  # (L,) [m/s^2 or rad/s^2]
    flying: bool

    @classmethod
    def of_robot(cls, robot: Robot) -> "MotionLimits":
        """Return a robot's limits; those that no description states are assumed."""
        carrier = np.array([FLYING_VELOCITY, FLYING_ACCELERATION])
        if robot.arm is not None:
            carrier = _dof_limits(robot.arm.model, ARM_ACCELERATION)
        velocity, acceleration = np.hstack([carrier, _dof_limits(robot.hand, FINGER_ACCELERATION)])
        return cls(velocity, acceleration, robot.arm is None)

    def rates(self, differences: Floats) -> Floats:
        """Return (M, L) amounts of change, in the order of the limits, for differences of states (M, D).
        For accelerations of a rotation this is an upper bound."""
        if not self.flying:
            return np.abs(differences)
        place, turn = (np.linalg.norm(part, axis=1) for part in (differences[:, :3], 2 * differences[:, 3:7]))
        return np.column_stack([place, turn, np.abs(differences[:, 7:])])

    def continuous(self, states: Floats) -> Floats:
        """Return states (M, D) whose quaternions have no change of sign between neighbours."""
        found = np.array(states, float)
        if self.flying:
            opposed = (found[1:, 3:7] * found[:-1, 3:7]).sum(axis=1) < 0
            found[1:, 3:7] *= np.cumprod(np.where(opposed, -1.0, 1.0))[:, None]
        return found

    def curve(self, path: Floats, shares: Floats) -> Floats:
        """Return states (T, D) at shares (T,) of a path (M, D), whose points are at equal shares."""
        from scipy.interpolate import BSpline  # slow to load

        count = max(4, len(path))
        knots = np.concatenate([np.zeros(3), np.linspace(0, 1, count - 2), np.ones(3)])
        # With control points at the means of three knots, a spline of points on a line is that line.
        controls = np.lib.stride_tricks.sliding_window_view(knots[1:-1], 3).mean(axis=1) * (len(path) - 1)
        path = self.continuous(path)
        left = np.minimum(controls.astype(int), len(path) - 2)
        states = path[left] + (controls - left)[:, None] * (path[left + 1] - path[left])
        found = np.asarray(BSpline(knots, states, 3)(shares))
        if self.flying:
            found[:, 3:7] /= np.linalg.norm(found[:, 3:7], axis=1, keepdims=True)
        return found

    def timed(self, path: Floats, nominal: float, step: float) -> Floats:
        """Return states (T, D) every `step` [s], without the start; the duration is at least `nominal` [s]."""
        slow = self.curve(path, minimum_jerk(_FINE))
        velocity = self.rates(np.diff(slow, axis=0)) * (len(_FINE) - 1) / self.velocity
        acceleration = self.rates(np.diff(slow, 2, axis=0)) * (len(_FINE) - 1) ** 2 / self.acceleration
        seconds = max(nominal, float(velocity.max()), math.sqrt(float(acceleration.max())))
        count = math.ceil(seconds / step - 1e-9)
        return self.curve(path, minimum_jerk(np.arange(1, count + 1) / count))

    def resampled(self, corners: Floats, points: int) -> Floats:
        """Return states (points, D) on lines between corners (C, D), at equal times at full velocity."""
        corners = self.continuous(corners)
        times = (self.rates(np.diff(corners, axis=0)) / self.velocity).max(axis=1)
        at = np.concatenate([[0.0], np.cumsum(np.maximum(times, 1e-9))])
        wanted = np.linspace(0.0, at[-1], points)
        return np.stack([np.interp(wanted, at, column) for column in corners.T], axis=1)


def _dof_limits(tree: HandModel, acceleration: tuple[float, float]) -> Floats:
    """Return velocity and acceleration limits (2, D) of dofs."""
    lead = tree.joint_body[tree.first_joint]
    velocity = velocity_limits(tree).velocity[tree.first_joint] / np.abs(tree.multiplier[lead])
    return np.stack([velocity, np.where(tree.joint_type[lead] == JointType.REVOLUTE, *acceleration)])
