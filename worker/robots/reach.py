"""Which grasps an arm can carry out: inverse kinematics along the whole way, joint limits, collisions.

Differential inverse kinematics by mink: each step is a quadratic program in the joints' increments that holds their
limits. From one pose of the way to the next the arm must move on without a jump.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np

from service.model.errors import InputError
from service.model.transforms import Floats
from worker.quality.referee.decomposition import ConvexPieces
from worker.robots.arm import Arm
from worker.robots.execution import Executions
from worker.robots.timing import Path, straight_paths
from worker.robots.world import MOUNT, World, arm_spec
from worker.run import ALONE, Run

#: The hand is where it should be within this [m, rad].
NEAR_M: Final = 1e-4
NEAR_RAD: Final = 1e-3
#: Postures from which the arm sets out to find the grasp, and steps of each search.
STARTS: Final = 24
STEPS: Final = 80
#: Farthest that a joint moves from one point of the way to the next, 5 mm [rad or m].
JUMP: Final = 0.25
#: Points of the two long motions, and of those in which mainly the fingers move.
LONG: Final = 21
SHORT: Final = 5
_LONG_PHASES: Final = ("approach", "lift")
#: Why an arm does not carry out a grasp.
REASONS: Final = ("out of reach", "way not possible", "collision")


@dataclass
class Reached:
    """What an arm can do of N grasps."""

    rows: list[int] = field(default_factory=list)
    """Those that it carries out, of the N."""
    paths: list[list[Path]] = field(default_factory=list)
    """Their motions; joints are the arm's, then the hand's."""
    refused: Counter[str] = field(default_factory=Counter)
    """How many of the others for which reason."""
    tried: int = 0

    @property
    def share(self) -> float:
        """Of those that were tried."""
        return len(self.rows) / max(1, self.tried)


class Reach:
    """Searches the ways of one arm with one hand around one object. Not for several threads at once."""

    def __init__(self, arm: Arm, base: Floats, found: Executions, pieces: ConvexPieces) -> None:
        """Raises InputError where mink is not installed."""
        try:
            import mink
        except ImportError:
            raise InputError("arms need mink; run pip install 'graspd[arm]'") from None
        self.arm, self.found = arm, found
        supports = () if found.placed is None else found.placed.supports
        self.world = World(arm, base, found.hand, pieces, supports)
        self._mink = mink
        self._model = arm_spec(arm, base).compile()
        self._configuration = mink.Configuration(self._model)
        self._task = mink.FrameTask(MOUNT, "site", position_cost=1.0, orientation_cost=0.3, lm_damping=1e-3)
        self._limits = [mink.ConfigurationLimit(self._model)]
        self._order = np.array([int(self._model.joint(f"arm{b}").qposadr[0]) for b in arm.model.joint_body], np.intp)

    def all(self, wanted: int = 0, run: Run = ALONE) -> Reached:
        """All grasps, or in their order until so many are found."""
        reached = Reached()
        for row in range(len(self.found)):
            run.check("the search of an arm's ways")
            reached.tried += 1
            paths, reason = self.one(row)
            if paths is None:
                reached.refused[reason] += 1
            else:
                reached.rows.append(row)
                reached.paths.append(paths)
            run.progress(row + 1, len(self.found), "inverse kinematics")
            if wanted and len(reached.rows) >= wanted:
                break
        return reached

    def one(self, row: int) -> tuple[list[Path] | None, str]:
        """The motions of one grasp, or why there are none: the reason of the start that got farthest."""
        long, short = (straight_paths(self.found, row, points) for points in (LONG, SHORT))
        ways = [a if a.phase in _LONG_PHASES else b for a, b in zip(long, short, strict=True)]
        rng, farthest, reason = np.random.default_rng(row), -1, ""
        arm = self.arm.model
        for start in range(STARTS):
            middle = 0.5 * (arm.lower + arm.upper)
            q = middle if start == 0 else rng.uniform(arm.lower, arm.upper)
            found, why = self._from(q, ways, row)
            if found is not None:
                return found, ""
            stage = next(k for k, one in enumerate(REASONS) if why.startswith(one))
            if stage > farthest:
                farthest, reason = stage, why
        return None, reason

    def _from(self, q: Floats, ways: list[Path], row: int) -> tuple[list[Path] | None, str]:
        """The motions from one start, or why there are none."""
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
        """(M, A) dofs along root poses (M, 7) of the hand, the first of which q has; None: not without a jump."""
        rows = [q]
        for pose in poses[1:]:
            onward = self._solve(rows[-1], pose, STEPS // 4)
            if onward is None or np.abs(onward - rows[-1]).max() > JUMP:
                return None
            rows.append(onward)
        return np.array(rows)

    def _solve(self, q: Floats, root_pose: Floats, steps: int) -> Floats | None:
        """Dofs (A,) that put the hand's root link at a pose (7,), within the limits; None: not found from q."""
        mink, configuration, task = self._mink, self._configuration, self._task
        full = np.zeros(self._model.nq)
        full[self._order] = self.arm.model.expand(q)
        configuration.update(full)
        rotation = mink.SO3(np.asarray(root_pose[3:], float))
        task.set_target(mink.SE3.from_rotation_and_translation(rotation, np.asarray(root_pose[:3], float)))
        for _ in range(steps):
            error = task.compute_error(configuration)
            if np.linalg.norm(error[:3]) < NEAR_M and np.linalg.norm(error[3:]) < NEAR_RAD:
                found = self.arm.model.reduce(configuration.q[self._order])
                return found if self._inside(found) else None
            try:
                velocity: Any = mink.solve_ik(
                    configuration, [task], 1.0, solver="daqp", damping=1e-6, limits=self._limits
                )
            except mink.NoSolutionFound:
                return None
            configuration.integrate_inplace(velocity, 1.0)
        return None

    def _inside(self, q: Floats) -> bool:
        arm = self.arm.model
        return bool((q >= arm.lower - 1e-6).all() and (q <= arm.upper + 1e-6).all())

    def _collision(self, joined: list[Floats], ways: list[Path], row: int) -> str:
        """The first two bodies that meet on the way; empty: none do."""
        rest = np.asarray(self.found.object_pose[row], float)
        for arm, path in zip(joined, ways, strict=True):
            for q, joints, pose in zip(arm, path.joints, path.hand_pose, strict=True):
                at = rest.copy()
                if path.phase == "lift":
                    at[:3] += pose[:3] - path.hand_pose[0, :3]
                if pair := self.world.touches(q, joints, at):
                    return pair
        return ""
