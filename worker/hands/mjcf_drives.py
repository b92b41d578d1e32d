"""Drives and couplings of an MJCF model's joints: actuators, equalities, fixed tendons, closed loops.

Couplings are linear in their drivers. A four-bar linkage is a tree with ends connected by `connect` constraints. The
loops are solved over the drivers' ranges. A line approximates each passive joint, and a note reports its error."""

import itertools
from collections.abc import Callable, Collection, Mapping
from typing import Any, Final

import mujoco
import numpy as np

from graspd.service.model.errors import HandError
from graspd.service.model.transforms import Floats
from graspd.worker.hands.robot import Mimic

_RANGE_POINTS: Final = 41
_STEPS: Final = 33
_ROUNDS: Final = 60
#: Gap above which the ends of a loop do not meet [m].
_OPEN_M: Final = 2e-4
_ONE_VALUE: Final = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
#: Largest deviation of a passive joint from its line [rad].
MAX_ERROR_RAD: Final = 0.08


class Couplings:
    """Couplings between the joints of a compiled model; `name` returns the name of a joint."""

    def __init__(self, model: Any, name: Callable[[int], str]) -> None:
        self.model, self.name = model, name
        #: Mimic of each dependent joint, or the value at which an equality fixes it.
        self.follows: dict[int, Mimic | float] = {}
        #: Notes for the user.
        self.notes: list[str] = []
        #: Coefficients of the joints that a tendon pulls, by the name of its drive.
        self.tendons: dict[str, dict[int, float]] = {}
        #: Joints with an unsolved loop, and the error for a hand that moves by them.
        self.faults: dict[int, str] = {}
        self._driven = [driven_joints(model, actuator) for actuator in range(model.nu)]
        self._actuated = {joint for pulled in self._driven for joint, _ in pulled}
        active = [equality for equality in range(model.neq) if model.eq_active0[equality]]
        for equality in active:
            self._add_equality(equality)
        self._add_tendons()
        self._add_loops([e for e in active if model.eq_type[e] == int(mujoco.mjtEq.mjEQ_CONNECT)])
        self._fix_followers()

    def _add_equality(self, equality: int) -> None:
        first, second = int(self.model.eq_obj1id[equality]), int(self.model.eq_obj2id[equality])
        polynomial, kind = np.asarray(self.model.eq_data[equality, :5]), int(self.model.eq_type[equality])
        if kind == int(mujoco.mjtEq.mjEQ_JOINT):
            self._couple_joints(first, second, polynomial)
        if kind != int(mujoco.mjtEq.mjEQ_TENDON):
            return
        ends = [joints_on_tendon(self.model, tendon) if tendon >= 0 else [] for tendon in (first, second)]
        if len(ends[0]) == 2 and second < 0:
            self._couple_on_tendon(float(polynomial[0]), ends[0])
        elif len(ends[0]) == len(ends[1]) == 1:
            # c1 (q1 - q1_0) = p(c2 (q2 - q2_0))
            ((one, own),), ((other, pull),) = ends
            self._couple_joints(one, other, polynomial * pull ** np.arange(5) / own)
        else:
            self.notes.append("an equality of tendons with several joints was left out")

    def _fix_followers(self) -> None:
        """Fix the joints that follow a fixed joint."""
        held = {self.name(joint): value for joint, value in self.follows.items() if isinstance(value, float)}
        while moved := [(j, f) for j, f in self.follows.items() if isinstance(f, Mimic) and f.joint in held]:
            for joint, follows in moved:
                value = follows.multiplier * held[follows.joint] + follows.offset
                self.follows[joint] = held[self.name(joint)] = float(np.clip(value, *self._joint_range(joint)))

    def _couple_joints(self, first: int, second: int, polynomial: Floats) -> None:
        """Couple by first - first0 = p(second - second0); a nonlinear p is replaced by its best line."""
        if second < 0:
            self.follows[first] = self._rest_position(first) + float(polynomial[0])
            return
        if first in self.follows or first == second or self._is_driven_by(second, first):
            self.notes.append(f"a second equality of {self.name(first)!r} was left out")
            return
        constant, slope = float(polynomial[0]), float(polynomial[1])
        if np.abs(polynomial[2:]).max() > 1e-9:
            at = np.linspace(*self._joint_range(second), _RANGE_POINTS) - self._rest_position(second)
            values = np.asarray(np.polynomial.polynomial.polyval(at, polynomial), float)
            slope, constant, error = _fit_line(at, values)
            self.notes.append(f"{self.name(first)!r} follows {self.name(second)!r} by a line within {error:.2g}")
        offset = self._rest_position(first) + constant - slope * self._rest_position(second)
        self.follows[first] = Mimic(self.name(second), slope, offset)

    def _is_driven_by(self, joint: int, first: int) -> bool:
        """Check whether a joint follows another one through any chain."""
        number = {self.name(j): j for j in self.follows}
        while isinstance(follows := self.follows.get(joint), Mimic):
            if follows.joint == self.name(first):
                return True
            joint = number.get(follows.joint, -1)
        return False

    def _couple_on_tendon(self, length: float, pulled: list[tuple[int, float]]) -> None:
        """Couple two joints on a fixed tendon: c1 (q1 - q1_0) + c2 (q2 - q2_0) = length.
        The joint without actuator follows; at its limit it stops, as in a finger with a compliant end."""
        free = [pair for pair in pulled if pair[0] not in self.follows and pair[0] not in self._actuated]
        if not free or abs(free[-1][1]) < 1e-9:
            self.notes.append(f"a tendon of {' and '.join(self.name(joint) for joint, _ in pulled)} was left out")
            return
        joint, coefficient = free[-1]
        ((driver, pull),) = [pair for pair in pulled if pair[0] != joint]
        at = np.linspace(*self._joint_range(driver), _RANGE_POINTS)
        line = self._rest_position(joint) + (length - pull * (at - self._rest_position(driver))) / coefficient
        values = np.clip(line, *self._joint_range(joint))
        if np.ptp(values) < 1e-6:
            self.follows[joint] = float(values[0])
            reason = "its limits prevent the motion that its tendon requires"
            self.notes.append(f"{self.name(joint)!r} stays at {values[0]:.3g}: {reason}")
            return
        slope, constant, error = _fit_line(at, values)
        self.follows[joint] = Mimic(self.name(driver), slope, constant)
        if error > 1e-6:
            self.notes.append(f"{self.name(joint)!r} follows {self.name(driver)!r} by a line within {error:.2g}")

    def _add_tendons(self) -> None:
        """Couple joints that share one actuated tendon and have no other drive.
        Serial joints of one finger share the tendon according to contact. Parallel joints (jaws of a gripper) move in
        proportion to their coefficients; otherwise the object could move from side to side."""
        alone = {pulled[0][0] for pulled in self._driven if len(pulled) == 1}
        for actuator, pulled in enumerate(self._driven):
            free = [(j, c) for j, c in pulled if j not in self.follows and j not in alone and abs(c) > 1e-9]
            if len(free) < 2:
                continue
            if self._is_chain([joint for joint, _ in free]):
                self.tendons[str(self.model.actuator(actuator).name) or f"tendon_{actuator}"] = dict(free)
                continue
            (driver, pull), *others = free
            for joint, coefficient in others:
                self.follows[joint] = Mimic(self.name(driver), coefficient / pull, 0.0)
            followers = ", ".join(self.name(joint) for joint, _ in others)
            self.notes.append(f"{followers} assumed to follow {self.name(driver)} on their tendon")

    def _is_chain(self, joints: list[int]) -> bool:
        """Check whether the joints form one chain."""
        chains = sorted(
            (set(bodies_to_root(self.model, int(self.model.jnt_bodyid[joint]))) for joint in joints), key=len
        )
        return all(a <= b for a, b in itertools.pairwise(chains))

    def _joint_range(self, joint: int) -> tuple[float, float]:
        lower, upper = self.model.jnt_range[joint] if self.model.jnt_limited[joint] else (-np.pi, np.pi)
        return float(lower), float(upper)

    def _rest_position(self, joint: int) -> float:
        return float(self.model.qpos0[self.model.jnt_qposadr[joint]])

    def _add_loops(self, loops: list[int]) -> None:
        """Solve the loops of the model; record a fault for joints of a loop that cannot be solved."""
        for group in _connected_loops(self.model, loops):
            joints = sorted({j for e in group for j in _loop_joints(self.model, e)})
            passive = [j for j in joints if j not in self._actuated and j not in self.follows]
            if not passive:
                continue
            try:
                self._add_loop_mimics(group, joints, passive)
            except HandError as error:
                # The fault only matters if the hand moves by this joint.
                self.faults |= dict.fromkeys(passive, str(error))

    def _add_loop_mimics(self, group: list[int], joints: list[int], passive: list[int]) -> None:
        """Add the mimics of the passive joints in a group of loops.
        Raises HandError: a joint is no hinge or slide, the group has no single driver, it does not close over the
        driver's range, or a joint depends on the driver nonlinearly."""
        held = ", ".join(map(self.name, joints))
        if balls := [j for j in joints if int(self.model.jnt_type[j]) not in _ONE_VALUE]:
            raise HandError(
                f"the loop of {held} cannot be solved: {self.name(balls[0])} is no hinge or slide joint; "
                "write equalities of joints instead of the loop"
            )
        drivers = [j for j in joints if j in self._actuated and j not in self.follows]
        # Without an actuator in the loop, the joint that follows a joint outside is the driver.
        drivers = drivers or [j for j in joints if j in self.follows and not isinstance(self.follows[j], float)]
        if not drivers:
            raise HandError(f"the loop of {held} has no driver; give one of its joints an actuator")
        if len(drivers) > 1:
            many = " and ".join(map(self.name, drivers))
            raise HandError(
                f"the loop of {held} has {len(drivers)} drivers ({many}), but only loops with one driver are solved; "
                "leave one actuator in it, or write equalities of joints instead of the loop"
            )
        driver = self.name(drivers[0])
        values, followers = self._solve_loops(group, drivers[0], passive)
        lines = [_fit_line(values, follower) for follower in followers.T]
        for joint, (_, _, error) in zip(passive, lines, strict=True):
            if error > MAX_ERROR_RAD:
                raise HandError(
                    f"the loop of {driver!r} moves {self.name(joint)!r} nonlinearly (error {error:.2f}); "
                    "write an equality of the two joints instead"
                )
        mimics = [Mimic(driver, slope, constant) for slope, constant, _ in lines]
        self.follows |= dict(zip(passive, mimics, strict=True))
        worst = max(error for _, _, error in lines)
        self.notes.append(f"{', '.join(map(self.name, passive))} follow {driver} within {worst:.2g} rad")

    def _solve_loops(self, loops: list[int], driver: int, passive: list[int]) -> tuple[Floats, Floats]:
        """Return the values of the driver (S,) and of the passive joints (S, P) at which the loops are closed."""
        data = mujoco.MjData(self.model)
        lower, upper = self._joint_range(driver)
        start = float(np.clip(self._rest_position(driver), lower, upper))
        values = np.linspace(lower, upper, _STEPS)
        # From the model's initial value to both ends; each step starts from the last solution.
        order = np.concatenate([np.flatnonzero(values >= start), np.flatnonzero(values < start)[::-1]])
        solved = np.full((_STEPS, len(passive)), np.nan)
        rest = np.array([self._rest_position(joint) for joint in passive])
        for step in order:
            behind = step - 1 if values[step] >= start else step + 1
            known = 0 <= behind < _STEPS and not np.isnan(solved[behind]).any()
            guess = solved[behind] if known else rest
            solved[step], gap = _close_loops(self.model, data, loops, driver, values[step], passive, guess)
            if gap > _OPEN_M:
                opening = f"open by {1e3 * gap:.1f} mm at {values[step]:.2f}"
                raise HandError(f"the loop of {self.name(driver)!r} is {opening}; correct its range")
        return values, solved


def _fit_line(at: Floats, values: Floats) -> tuple[float, float, float]:
    """Return slope, constant and largest error of the best line."""
    slope, constant = map(float, np.polyfit(at, values, 1))
    return slope, constant, float(np.abs(values - constant - slope * at).max())


def _connected_loops(model: Any, loops: list[int]) -> list[list[int]]:
    groups: list[tuple[set[int], list[int]]] = []
    for loop in loops:
        joints = set(_loop_joints(model, loop))
        touching = [group for group in groups if group[0] & joints]
        merged = (joints.union(*(g[0] for g in touching)), [e for g in touching for e in g[1]] + [loop])
        groups = [group for group in groups if group not in touching] + [merged]
    return [members for _, members in groups]


def _loop_bodies(model: Any, loop: int) -> tuple[int, int]:
    first, second = int(model.eq_obj1id[loop]), int(model.eq_obj2id[loop])
    if model.eq_objtype[loop] == int(mujoco.mjtObj.mjOBJ_SITE):
        return int(model.site_bodyid[first]), int(model.site_bodyid[second])
    return first, max(second, 0)


def _loop_joints(model: Any, loop: int) -> list[int]:
    """Return the joints between a loop's ends and the body at which their chains branch."""
    chains = [bodies_to_root(model, body) for body in _loop_bodies(model, loop)]
    common = set(chains[0]) & set(chains[1])
    return [
        joint
        for chain in chains
        for body in chain
        if body not in common
        for joint in range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])
    ]


def bodies_to_root(model: Any, body: int) -> list[int]:
    """Return the bodies from this one up to a child of the world."""
    found = []
    while body:
        found.append(body)
        body = int(model.body_parentid[body])
    return found


def _close_loops(
    model: Any, data: Any, loops: list[int], driver: int, value: float, passive: list[int], guess: Floats
) -> tuple[Floats, float]:
    """Solve for passive joint values at a driver value (Gauss-Newton); also return the loops' gap [m]."""
    address, dofs = [int(model.jnt_qposadr[j]) for j in passive], [int(model.jnt_dofadr[j]) for j in passive]
    q, gap = guess.copy(), np.inf
    jacobians = np.zeros((2, 3, model.nv))
    for _ in range(_ROUNDS):
        data.qpos[:] = model.qpos0
        data.qpos[model.jnt_qposadr[driver]] = value
        data.qpos[address] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        rows, residuals = [], []
        for loop in loops:
            points = _anchors(model, data, loop)
            for k, (point, body) in enumerate(zip(points, _loop_bodies(model, loop), strict=True)):
                mujoco.mj_jac(model, data, jacobians[k], None, point, body)
            rows.append((jacobians[0] - jacobians[1])[:, dofs])
            residuals.append(points[0] - points[1])
        residual = np.concatenate(residuals)
        gap = float(np.abs(residual).max())
        step = np.linalg.lstsq(np.concatenate(rows), -residual, rcond=1e-8)[0]
        q = q + np.clip(step, -0.2, 0.2)
        if np.abs(step).max() < 1e-10:
            break
    return q, gap


def _anchors(model: Any, data: Any, loop: int) -> tuple[Floats, Floats]:
    """Return the two points that a connect constraint joins, in the world frame."""
    if model.eq_objtype[loop] == int(mujoco.mjtObj.mjOBJ_SITE):
        return data.site_xpos[int(model.eq_obj1id[loop])], data.site_xpos[int(model.eq_obj2id[loop])]
    points = []
    for body, local in zip(_loop_bodies(model, loop), (model.eq_data[loop, :3], model.eq_data[loop, 3:6]), strict=True):
        points.append(data.xpos[body] + data.xmat[body].reshape(3, 3) @ local)
    return points[0], points[1]


def servo_parameters(
    model: Any, mimics: Mapping[int, Mimic | float], shared: Collection[int]
) -> dict[int, tuple[float, float]]:
    """Return effort [N m or N] and stiffness [N m/rad or N/m] of each driven joint; 0 if not stated.
    An actuator of gear g on a length l pulls joint q with g F dl/dq. A position servo of gain k gives the joint the
    stiffness k (g dl/dq)^2. The rate dl/dq is 1 for a driven joint; on a fixed tendon, it is the joint's coefficient
    plus coefficient times rate of each follower. Each of n joints that share a tendon (`shared`) gets n times the
    tendon's gain, so that their series has the tendon's gain."""
    found: dict[int, tuple[float, float]] = {}
    joint_of = {str(model.joint(j).name): j for j in range(model.njnt)}
    for actuator in range(model.nu):
        gear = float(model.actuator_gear[actuator, 0])
        rates: dict[int, float] = {}
        for joint, coefficient in driven_joints(model, actuator):
            driver, rate = _driving_joint(joint, mimics, joint_of)
            if driver is not None:
                rates[driver] = rates.get(driver, 0.0) + coefficient * rate
        for joint, rate in rates.items():
            arm = abs(gear * rate)
            gain = _servo_gain(model, actuator) * (len(rates) if joint in shared else 1)
            effort, stiffness = found.get(joint, (0.0, 0.0))
            found[joint] = effort + arm * _force_limit(model, actuator), stiffness + arm**2 * gain
    for joint, (effort, stiffness) in found.items():
        if model.jnt_actfrclimited[joint]:
            most = float(np.abs(model.jnt_actfrcrange[joint]).max())
            found[joint] = min(effort, most) or most, stiffness
    return found


def commanded_ranges(model: Any) -> dict[int, tuple[float, float]]:
    """Return the range of equilibrium positions that each joint's position servo can command."""
    found = {}
    for actuator in range(model.nu):
        kind, gain = int(model.actuator_trntype[actuator]), _servo_gain(model, actuator)
        gear = float(model.actuator_gear[actuator, 0])
        if kind != int(mujoco.mjtTrn.mjTRN_JOINT) or gain <= 0 or not gear or not model.actuator_ctrllimited[actuator]:
            continue
        force = float(model.actuator_gainprm[actuator, 0]) * np.asarray(model.actuator_ctrlrange[actuator], float)
        ends = (force + float(model.actuator_biasprm[actuator, 0])) / (gain * gear)
        if np.ptp(ends) > 1e-6:
            found[int(model.actuator_trnid[actuator, 0])] = float(ends.min()), float(ends.max())
    return found


def driven_joints(model: Any, actuator: int) -> list[tuple[int, float]]:
    """Return the joints that an actuator moves, each with the derivative of the actuator's length."""
    kind, target = int(model.actuator_trntype[actuator]), int(model.actuator_trnid[actuator, 0])
    if kind in (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)):
        return [(target, 1.0)]
    return joints_on_tendon(model, target) if kind == int(mujoco.mjtTrn.mjTRN_TENDON) else []


def joints_on_tendon(model: Any, tendon: int) -> list[tuple[int, float]]:
    """Return the joints on a fixed tendon, each with its coefficient."""
    first, kind = int(model.tendon_adr[tendon]), int(mujoco.mjtWrap.mjWRAP_JOINT)
    wraps = [w for w in range(first, first + int(model.tendon_num[tendon])) if model.wrap_type[w] == kind]
    return [(int(model.wrap_objid[w]), float(model.wrap_prm[w])) for w in wraps]


def _driving_joint(
    joint: int, mimics: Mapping[int, Mimic | float], joint_of: Mapping[str, int]
) -> tuple[int | None, float]:
    """Return the joint that drives `joint` through mimics, and the total rate; None and 0 if it is fixed."""
    rate = 1.0
    for _ in range(len(mimics) + 1):
        follows = mimics.get(joint)
        if follows is None:
            return joint, rate
        if isinstance(follows, float) or follows.joint not in joint_of:
            return None, 0.0
        rate *= follows.multiplier
        joint = joint_of[follows.joint]
    return None, 0.0


def _force_limit(model: Any, actuator: int) -> float:
    """Return the largest force; 0 if the model states none."""
    if model.actuator_forcelimited[actuator]:
        return float(np.abs(model.actuator_forcerange[actuator]).max())
    if model.actuator_ctrllimited[actuator] and model.actuator_biastype[actuator] == int(mujoco.mjtBias.mjBIAS_NONE):
        return abs(float(model.actuator_gainprm[actuator, 0])) * float(np.abs(model.actuator_ctrlrange[actuator]).max())
    return 0.0


def _servo_gain(model: Any, actuator: int) -> float:
    """Return the gain of a position servo; 0 for other actuators."""
    if model.actuator_biastype[actuator] != int(mujoco.mjtBias.mjBIAS_AFFINE):
        return 0.0
    return max(0.0, -float(model.actuator_biasprm[actuator, 1]))
