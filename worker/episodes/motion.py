"""Motions: timed targets of a robot for one grasp, from its home posture to the lifted object.

An arm's transit is a path of RRT-Connect (Kuffner and LaValle 2000), shortened at random. The seed alone determines it;
in OMPL, one random generator serves the whole process."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.transforms import Floats, quat_from_axis_angle, quat_multiply, quat_rotate
from graspd.worker.episodes.episode import PHASES, EpisodeOutcome, Robot
from graspd.worker.episodes.execution import Executions, Path, straight_paths
from graspd.worker.episodes.reach import ArmScene, ReachSearch, reason_stage
from graspd.worker.episodes.robots import rotation_between
from graspd.worker.episodes.timing import MotionLimits
from graspd.worker.hands.model import HandModel
from graspd.worker.validation.decomposition import ConvexPieces

#: Time between targets [s].
CONTROL_STEP_S: Final = 0.02
#: Duration of each phase where limits allow [s].
NOMINAL_S: Final = dict(zip(PHASES, (1.0, 0.7, 0.3, 0.4, 0.3, 0.8, 0.5), strict=True))
#: Home of a flying hand: its palm here in the scene, facing down, and half the range of seeded changes [m], [rad].
FLYING_HOME_M: Final = (-0.4, 0.0, 0.3)
FLYING_CHANGE_M: Final = 0.05
FLYING_CHANGE_RAD: Final = 0.5
#: Heights above home and standoff at which a flying hand passes obstacles [m].
DETOURS_M: Final = (0.1, 0.2, 0.3)
#: Clearance of a transit [m]; less if the standoff has less.
CLEARANCES_M: Final = (0.01, 0.002, 0.0)
#: Time between tested postures of a transit that is as fast as limits allow [s].
CHECK_S: Final = 0.01
#: Numbers of control points of a transit with corners, tried in turn.
CONTROLS: Final = (12, 24, 48)
#: Margin of sampled postures around both ends of an arm's transit [rad or m].
WIDER: Final = 1.5
#: Number of an arm's motions to the grasp from which a transit is tried.
MOST_TRANSITS: Final = 3
#: Length of a tree's steps and largest distance of tested points, by the joint that moves most [rad or m].
STEP: Final = 0.25
RESOLUTION: Final = 0.03
#: Numbers of samples until the search ends without a path, and of attempts to shorten a path.
SAMPLES: Final = 400
SHORTCUTS: Final = 60
_Test = Callable[[Floats], bool]


@dataclass(frozen=True)
class Motion:
    """K targets of a robot at equal times; the first is its home posture at rest."""

    phase: NDArray[np.uint8]  # (K,) indices of `PHASES`
    time: Floats  # (K,) times since the start [s]
    targets: Floats  # (K, D) in the order of `Robot.names` [m, 1, rad]


class MotionPlanner:
    """Planner of the motions of one robot for grasps of one object. Not thread-safe.
    The motion of a grasp depends on `seed` and the grasp's row in its shard, not on other grasps."""

    def __init__(
        self, robot: Robot, found: Executions, pieces: ConvexPieces, *, seed: int = 0, step: float = CONTROL_STEP_S
    ) -> None:
        self.robot, self.found, self.seed, self.step = robot, found, seed, step
        self.limits = MotionLimits.of_robot(robot)
        self._split = len(robot.names) - robot.hand.dofs  # number of the arm's dofs, or of the root pose's values
        self._clearance = CLEARANCES_M[0]
        if robot.arm is None:
            self._world = ArmScene(None, robot.base, robot.hand, pieces, found.placed)
        else:
            self._reach = ReachSearch(robot.arm, robot.base, found, pieces)
            self._world = self._reach.world

    def plan(self, row: int) -> Motion | EpisodeOutcome:
        """Return the motion of one grasp, or the reason why the robot cannot execute it."""
        rng = np.random.default_rng([self.seed, int(self.found.rows[row])])
        self._world.place_neighbours(row)
        return self._plan_flight(row, rng) if self.robot.arm is None else self._plan_arm(row, rng)

    def _plan_flight(self, row: int, rng: np.random.Generator) -> Motion | EpisodeOutcome:
        hand = self.robot.hand
        paths = [np.hstack([path.hand_pose, hand.reduce(path.joints)]) for path in straight_paths(self.found, row)]
        end = paths[0][0]
        home = np.concatenate([flying_home(hand, rng), end[7:]])
        self._choose_clearance(end, row)
        for height in (0.0, *DETOURS_M):
            corners = np.stack([home, home, end, end] if height else [home, end])
            corners[1:-1, 2] = max(home[2], end[2]) + height
            if (transit := self._free_path(corners, row)) is not None:
                return self._timed([transit, *paths])
        return EpisodeOutcome.NO_TRANSIT

    def _plan_arm(self, row: int, rng: np.random.Generator) -> Motion | EpisodeOutcome:
        reason, tried = "", 0
        for ways, why in self._reach.attempts(row):
            if ways is None:
                reason = max(reason, why, key=reason_stage)
                continue
            paths = [self._states(path) for path in ways]
            if (transit := self._arm_transit(paths[0][0], row, rng)) is not None:
                return self._timed([transit, *paths])
            if (tried := tried + 1) == MOST_TRANSITS:
                break
        code = EpisodeOutcome.OUT_OF_REACH + reason_stage(reason)
        return EpisodeOutcome.NO_TRANSIT if tried else EpisodeOutcome(code)

    def _states(self, path: Path) -> Floats:
        assert self.robot.arm is not None
        tree = self.robot.arm.model
        of_arm, of_hand = np.split(path.joints, [len(tree.joint_names)], axis=1)
        return np.hstack([tree.reduce(of_arm), self.robot.hand.reduce(of_hand)])

    def _arm_transit(self, end: Floats, row: int, rng: np.random.Generator) -> Floats | None:
        """Return a free path (M, D) of an arm from its home posture, with the hand as at the end, or None."""
        assert self.robot.arm is not None
        tree, home, held = self.robot.arm.model, self.robot.arm.home, end[self._split :]
        corners = np.stack([np.concatenate([home, held]), end])
        self._choose_clearance(end, row)
        if (path := self._free_path(corners, row)) is not None:
            return path
        goal = end[: self._split]
        ends = np.stack([np.minimum(home, goal) - WIDER, np.maximum(home, goal) + WIDER])
        low, high = np.clip(ends, tree.lower, tree.upper)
        free = connect(home, goal, low, high, lambda q: self._is_free(np.concatenate([q, held]), row), rng)
        if free is None:
            return None
        return self._free_path(np.hstack([free, np.tile(held, (len(free), 1))]), row)

    def _free_path(self, corners: Floats, row: int) -> Floats | None:
        """Return a path (M, D) near lines between corners (C, D) whose curve is free, or None."""
        for points in CONTROLS if len(corners) > 2 else (4,):
            path = self.limits.resampled(corners, points)
            if all(self._is_free(state, row) for state in self.limits.timed(path, 0.0, CHECK_S)):
                return path
        return None

    def _is_free(self, state: Floats, row: int) -> bool:
        joints = self.robot.hand.expand(state[self._split :])
        world, rest = self._world, self.found.object_pose[row]
        return not world.first_collision(state[: self._split], joints, rest, clearance=self._clearance)

    def _choose_clearance(self, end: Floats, row: int) -> None:
        """Choose the largest clearance that the end of a transit has."""
        for self._clearance in CLEARANCES_M:
            if self._is_free(end, row):
                break

    def _timed(self, paths: list[Floats]) -> Motion:
        """Return the sequence of timed paths (M, D), all from rest to rest, and the hold."""
        parts = [self.limits.timed(path, NOMINAL_S[PHASES[k]], self.step) for k, path in enumerate(paths)]
        parts.append(np.repeat(paths[-1][-1:], round(NOMINAL_S["hold"] / self.step), axis=0))
        phase = np.repeat(np.arange(len(parts), dtype=np.uint8), [len(part) for part in parts])
        targets = self.limits.continuous(np.concatenate([paths[0][:1], *parts]))
        time = self.step * np.arange(len(targets), dtype=np.float64)
        return Motion(np.concatenate([[phase[0]], phase]), time, targets)


def flying_home(hand: HandModel, rng: np.random.Generator) -> Floats:
    """Return the root pose (7,) of a flying hand at home."""
    place = np.array(FLYING_HOME_M) + rng.uniform(-FLYING_CHANGE_M, FLYING_CHANGE_M, 3)
    yaw = np.array(rng.uniform(-FLYING_CHANGE_RAD, FLYING_CHANGE_RAD))
    down = rotation_between(hand.palm.approach, np.array([0.0, 0.0, -1.0]))
    turn = quat_multiply(quat_from_axis_angle(np.array([0.0, 0.0, 1.0]), yaw), down)
    return np.concatenate([place - quat_rotate(turn, hand.palm.centre), turn])


def is_free_line(start: Floats, end: Floats, is_free: _Test) -> bool:
    """Return whether points of a line (A,), at most `RESOLUTION` apart and without its start, are free."""
    count = max(1, math.ceil(float(np.abs(end - start).max()) / RESOLUTION))
    return all(is_free(start + (k / count) * (end - start)) for k in range(count, 0, -1))


def connect(
    start: Floats, goal: Floats, low: Floats, high: Floats, is_free: _Test, rng: np.random.Generator
) -> Floats | None:
    """Return the corners (C, A) of a free path between two configurations (A,), or None if none is found.
    Samples are between `low` and `high` (A,)."""
    if not (is_free(start) and is_free(goal)):
        return None
    # Each entry of a tree is the path from its root to a node.
    tree, other = [[start]], [[goal]]
    for k in range(SAMPLES):
        if _extend(tree, rng.uniform(low, high), is_free) is not None:
            while (joined := _extend(other, tree[-1][-1], is_free)) is False:
                pass
            if joined:
                path = [*tree[-1], *other[-1][-2::-1]]
                return _shortened(path if k % 2 == 0 else path[::-1], is_free, rng)
        tree, other = other, tree
    return None


def _extend(tree: list[list[Floats]], towards: Floats, is_free: _Test) -> bool | None:
    """Add a node at most `STEP` nearer to a point. Return whether it is there; None without a free step."""
    near = tree[int(np.argmin(np.linalg.norm([path[-1] for path in tree] - towards, axis=1)))]
    way = towards - near[-1]
    share = min(1.0, STEP / max(float(np.abs(way).max()), 1e-12))
    node = near[-1] + share * way
    if not is_free_line(near[-1], node, is_free):
        return None
    tree.append([*near, node])
    return share == 1.0


def _shortened(path: list[Floats], is_free: _Test, rng: np.random.Generator) -> Floats:
    for _ in range(SHORTCUTS):
        i, j = sorted(rng.choice(len(path), 2, replace=False))
        if j - i > 1 and is_free_line(path[i], path[j], is_free):
            path = [*path[: i + 1], *path[j:]]
    return np.array(path)
