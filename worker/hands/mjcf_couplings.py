"""Couplings of an MJCF model, linear in their drivers: joint equalities, fixed tendons, closed loops.

A four-bar linkage is a tree with ends connected by `connect` constraints. The loops are solved over the drivers'
ranges, and each passive joint is fitted by a line in its driver, with the resulting error.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import mujoco
import numpy as np

from graspd.service.model.errors import HandError
from graspd.service.model.transforms import Floats
from graspd.worker.hands.mjcf_servos import driven, joints_on_tendon
from graspd.worker.hands.robot import Mimic

_RANGE_POINTS: Final = 41
#: Coefficients of the joints that a tendon pulls, by the name of its drive.
Tendons = dict[str, dict[int, float]]


@dataclass(frozen=True)
class Couplings:
    """Couplings between the joints of a model."""

    follows: dict[int, Mimic | float]
    """Mimic of each dependent joint, or the value at which an equality fixes it."""
    notes: list[str]
    """Notes for the user."""
    tendons: Tendons
    faults: dict[int, str]
    """Joints with an unsolved loop, and the reason."""


def couplings(model: Any, name: Callable[[int], str]) -> Couplings:
    """Find the couplings of a compiled model; `name` returns the name of a joint."""
    found: dict[int, Mimic | float] = {}
    notes: list[str] = []
    for equality in range(model.neq):
        if not model.eq_active0[equality]:
            continue
        first, second = int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality])
        kind = int(model.eq_type[equality])
        if kind == int(mujoco.mjtEq.mjEQ_TENDON):
            ends = [joints_on_tendon(model, tendon) if tendon >= 0 else [] for tendon in (first, second)]
            if len(ends[0]) == 2 and second < 0:
                _note(notes, _couple_on_tendon(model, equality, ends[0], found, name))
                continue
            if len(ends[0]) != 1 or len(ends[1]) != 1:
                notes.append("an equality of tendons with several joints was left out")
                continue
            _note(notes, _couple_tendons(model, equality, ends[0][0], ends[1][0], found, name))
        elif kind == int(mujoco.mjtEq.mjEQ_JOINT):
            _note(notes, _couple(model, first, second, np.asarray(model.eq_data[equality, :5]), found, name))
    more, tendons = _couple_by_tendons(model, found, name)
    said, faults = follow_loops(model, found, name)
    _hold_followers(model, found, name)
    return Couplings(found, notes + more + said, tendons, faults)


def _hold_followers(model: Any, found: dict[int, Mimic | float], name: Callable[[int], str]) -> None:
    """Fix the joints that follow a fixed joint."""
    held = {name(joint): value for joint, value in found.items() if isinstance(value, float)}
    while moved := [(j, f) for j, f in found.items() if isinstance(f, Mimic) and f.joint in held]:
        for joint, follows in moved:
            value = follows.multiplier * held[follows.joint] + follows.offset
            found[joint] = held[name(joint)] = float(np.clip(value, *_range(model, joint)))


def _note(notes: list[str], text: str) -> None:
    if text:
        notes.append(text)


def _couple(
    model: Any, first: int, second: int, polynomial: Any, found: dict[int, Mimic | float], name: Callable[[int], str]
) -> str:
    """Couple by first - first0 = p(second - second0); p of degree 4 is replaced by its best line."""
    rest = [float(model.qpos0[model.jnt_qposadr[joint]]) if joint >= 0 else 0.0 for joint in (first, second)]
    if second < 0:
        found[first] = rest[0] + float(polynomial[0])
        return ""
    if first in found or first == second or _leads_to(second, first, found, name):
        return f"a second equality of {name(first)!r} was left out"
    constant, slope, note = float(polynomial[0]), float(polynomial[1]), ""
    if np.abs(polynomial[2:]).max() > 1e-9:
        lower, upper = _range(model, second)
        at = np.linspace(lower, upper, _RANGE_POINTS) - rest[1]
        values = np.polynomial.polynomial.polyval(at, polynomial)
        slope, constant = map(float, np.polyfit(at, values, 1))
        error = float(np.abs(values - constant - slope * at).max())
        note = f"{name(first)!r} follows {name(second)!r} by a line within {error:.2g}"
    found[first] = Mimic(name(second), slope, rest[0] + constant - slope * rest[1])
    return note


def _leads_to(joint: int, first: int, found: dict[int, Mimic | float], name: Callable[[int], str]) -> bool:
    """Check whether a joint follows another one through any chain."""
    number = {name(j): j for j in found}
    while isinstance(follows := found.get(joint), Mimic):
        if follows.joint == name(first):
            return True
        joint = number.get(follows.joint, -1)
    return False


def _couple_tendons(
    model: Any,
    equality: int,
    one: tuple[int, float],
    other: tuple[int, float],
    found: dict[int, Mimic | float],
    name: Callable[[int], str],
) -> str:
    """Do the same for tendons of one joint each: c1 (q1 - q1_0) = p(c2 (q2 - q2_0))."""
    scaled = np.asarray(model.eq_data[equality, :5]) * other[1] ** np.arange(5) / one[1]
    return _couple(model, one[0], other[0], scaled, found, name)


def _couple_on_tendon(
    model: Any,
    equality: int,
    pulled: list[tuple[int, float]],
    found: dict[int, Mimic | float],
    name: Callable[[int], str],
) -> str:
    """Couple two joints on a fixed tendon: c1 (q1 - q1_0) + c2 (q2 - q2_0) = p0; the unactuated follows.

    Limits take precedence over the tendon: where they stop the follower it stays, as in a finger with a compliant end.
    """
    actuated = {joint for actuator in range(model.nu) for joint, _ in driven(model, actuator)}
    free = [pair for pair in pulled if pair[0] not in found and pair[0] not in actuated]
    if not free or abs(free[-1][1]) < 1e-9:
        return f"a tendon of {' and '.join(name(joint) for joint, _ in pulled)} was left out"
    joint, coefficient = free[-1]
    ((driver, pull),) = [pair for pair in pulled if pair[0] != joint]
    rest = [float(model.qpos0[model.jnt_qposadr[j]]) for j in (joint, driver)]
    at = np.linspace(*_range(model, driver), _RANGE_POINTS)
    line = rest[0] + (float(model.eq_data[equality, 0]) - pull * (at - rest[1])) / coefficient
    values = np.clip(line, *_range(model, joint))
    slope, constant = map(float, np.polyfit(at, values, 1))
    if np.ptp(values) < 1e-6:
        found[joint] = float(values[0])
        return f"{name(joint)!r} stays at {values[0]:.3g}: its limits stop what its tendon asks of it"
    found[joint] = Mimic(name(driver), slope, constant)
    error = float(np.abs(values - constant - slope * at).max())
    return f"{name(joint)!r} follows {name(driver)!r} by a line within {error:.2g}" if error > 1e-6 else ""


def _couple_by_tendons(
    model: Any, found: dict[int, Mimic | float], name: Callable[[int], str]
) -> tuple[list[str], Tendons]:
    """Couple joints that share one actuated tendon and have no other drive; return notes and tendons.

    Serial joints of one finger share the tendon according to contact. Parallel joints, the jaws of a gripper, bend in
    the ratio of its pull on them: if they shared it freely, the object could move from side to side.
    """
    alone = {
        pulled[0][0] for actuator in range(model.nu) if len(pulled := driven(model, actuator)) == 1
    }  # joints with an actuator of their own
    notes, tendons = [], {}
    for actuator in range(model.nu):
        free = [(j, c) for j, c in driven(model, actuator) if j not in found and j not in alone and abs(c) > 1e-9]
        if len(free) < 2:
            continue
        if _in_a_row(model, [joint for joint, _ in free]):
            tendons[str(model.actuator(actuator).name) or f"tendon_{actuator}"] = dict(free)
            continue
        (driver, pull), *others = free
        for joint, coefficient in others:
            found[joint] = Mimic(name(driver), coefficient / pull, 0.0)
        notes.append(f"{', '.join(name(joint) for joint, _ in others)} taken to follow {name(driver)} on their tendon")
    return notes, tendons


def _in_a_row(model: Any, joints: list[int]) -> bool:
    """Check whether the joints form one chain."""
    chains = []
    for joint in joints:
        chain, body = [], int(model.jnt_bodyid[joint])
        while body:
            chain.append(body)
            body = int(model.body_parentid[body])
        chains.append(frozenset(chain))
    chains.sort(key=len)
    return all(a <= b for a, b in itertools.pairwise(chains))


def _range(model: Any, joint: int) -> tuple[float, float]:
    if not model.jnt_limited[joint]:
        return -np.pi, np.pi
    lower, upper = model.jnt_range[joint]
    return float(lower), float(upper)


_STEPS: Final = 33
_ROUNDS: Final = 60
#: Gap above which the ends of a loop do not meet [m].
_OPEN_M: Final = 2e-4
_ONE_VALUE: Final = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
#: Largest deviation of a passive joint from its line [rad].
MAX_ERROR_RAD: Final = 0.08


def follow_loops(
    model: Any, found: dict[int, Mimic | float], name: Callable[[int], str]
) -> tuple[list[str], dict[int, str]]:
    """Add to `found` the joints that close the loops of a model.

    Returns:
        notes for the user; and joints with an unsolved loop, with the error for a hand that moves by them.
    """
    loops = [e for e in range(model.neq) if model.eq_type[e] == int(mujoco.mjtEq.mjEQ_CONNECT) and model.eq_active0[e]]
    actuated = {joint for actuator in range(model.nu) for joint, _ in driven(model, actuator)}
    notes: list[str] = []
    faults: dict[int, str] = {}
    for group in _groups(model, loops):
        joints = sorted({j for e in group for j in _on_loop(model, e)})
        passive = [j for j in joints if j not in actuated and j not in found]
        if not passive:
            continue
        try:
            notes.append(_follow(model, group, joints, passive, actuated, found, name))
        except HandError as error:
            # The fault only matters if the hand moves by this joint.
            faults |= dict.fromkeys(passive, str(error))
    return notes, faults


def _follow(
    model: Any,
    group: list[int],
    joints: list[int],
    passive: list[int],
    actuated: set[int],
    found: dict[int, Mimic | float],
    name: Callable[[int], str],
) -> str:
    """Add to `found` the mimics of the passive joints in a group of loops; return a note.

    Raises:
        HandError: it has no driver or several, does not close over its driver's range, or its joints are not linear.
    """
    held = ", ".join(map(name, joints))
    if round_ones := [j for j in joints if int(model.jnt_type[j]) not in _ONE_VALUE]:
        raise HandError(
            f"the loop of {held} turns on {name(round_ones[0])}, which is no hinge or slide joint, and is not solved; "
            "write equalities of joints instead of the loop"
        )
    drivers = [j for j in joints if j in actuated and j not in found]
    if not drivers:
        # Joints that follow others move with these.
        drivers = [j for j in joints if j in found and not isinstance(found[j], float)]
    if not drivers:
        raise HandError(f"the loop of {held} has no driver; give one of its joints an actuator")
    if len(drivers) > 1:
        many = " and ".join(map(name, drivers))
        raise HandError(
            f"the loop of {held} has {len(drivers)} drivers ({many}), and only loops of one are solved; leave one "
            "actuator in it, or write equalities of joints instead of the loop"
        )
    values, followers = _solve(model, group, drivers[0], passive, name)
    worst = 0.0
    lines: dict[int, Mimic | float] = {}
    for joint, follower in zip(passive, followers.T, strict=True):
        slope, constant = map(float, np.polyfit(values, follower, 1))
        error = float(np.abs(follower - constant - slope * values).max())
        if error > MAX_ERROR_RAD:
            raise HandError(
                f"the loop of {name(drivers[0])!r} moves {name(joint)!r} by no line (off by {error:.2f}); "
                "write an equality of the two joints instead"
            )
        worst = max(worst, error)
        lines[joint] = Mimic(name(drivers[0]), slope, constant)
    found |= lines
    return f"{', '.join(map(name, passive))} follow {name(drivers[0])} within {worst:.2g} rad"


def _groups(model: Any, loops: list[int]) -> list[list[int]]:
    """Group loops that share joints."""
    groups: list[tuple[set[int], list[int]]] = []
    for loop in loops:
        joints = set(_on_loop(model, loop))
        touching = [group for group in groups if group[0] & joints]
        merged = (joints.union(*(g[0] for g in touching)), [e for g in touching for e in g[1]] + [loop])
        groups = [group for group in groups if group not in touching] + [merged]
    return [members for _, members in groups]


def _ends(model: Any, loop: int) -> tuple[int, int]:
    """Return the bodies that a connect constraint joins."""
    first, second = int(model.eq_obj1id[loop]), int(model.eq_obj2id[loop])
    if model.eq_objtype[loop] == int(mujoco.mjtObj.mjOBJ_SITE):
        return int(model.site_bodyid[first]), int(model.site_bodyid[second])
    return first, max(second, 0)


def _on_loop(model: Any, loop: int) -> list[int]:
    """Return the joints between the ends and the body at which their chains branch."""
    chains = [_chain(model, body) for body in _ends(model, loop)]
    common = set(chains[0]) & set(chains[1])
    return [
        joint
        for chain in chains
        for body in chain
        if body not in common
        for joint in range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])
    ]


def _chain(model: Any, body: int) -> list[int]:
    found = []
    while body:
        found.append(body)
        body = int(model.body_parentid[body])
    return found


def _solve(
    model: Any, loops: list[int], driver: int, passive: list[int], name: Callable[[int], str]
) -> tuple[Floats, Floats]:
    """Return the values of the driver (S,) and of the passive joints (S, P) at which the loops are closed."""
    data = mujoco.MjData(model)
    lower, upper = map(float, model.jnt_range[driver]) if model.jnt_limited[driver] else (-np.pi, np.pi)
    start = float(np.clip(model.qpos0[model.jnt_qposadr[driver]], lower, upper))
    values = np.linspace(lower, upper, _STEPS)
    # From the model's initial value to both ends, each step starting from the last solution.
    order = np.concatenate([np.flatnonzero(values >= start), np.flatnonzero(values < start)[::-1]])
    solved = np.full((_STEPS, len(passive)), np.nan)
    rest = np.array([model.qpos0[model.jnt_qposadr[j]] for j in passive])
    for step in order:
        behind = step - 1 if values[step] >= start else step + 1
        known = 0 <= behind < _STEPS and not np.isnan(solved[behind]).any()
        guess, gap = _close(model, data, loops, driver, values[step], passive, solved[behind] if known else rest)
        if gap > _OPEN_M:
            raise HandError(
                f"the loop of {name(driver)!r} is open by {1e3 * gap:.1f} mm at {values[step]:.2f}; correct its range"
            )
        solved[step] = guess
    return values, solved


def _close(
    model: Any, data: Any, loops: list[int], driver: int, value: float, passive: list[int], guess: Floats
) -> tuple[Floats, float]:
    """Solve for passive joint values at a driver value (Gauss-Newton); also return the loops' gap [m]."""
    address, dofs = [int(model.jnt_qposadr[j]) for j in passive], [int(model.jnt_dofadr[j]) for j in passive]
    q = guess.copy()
    gap = np.inf
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
            for k, (point, body) in enumerate(zip(points, _ends(model, loop), strict=True)):
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
    """Return the two points, in the world frame, that a connect constraint joins."""
    if model.eq_objtype[loop] == int(mujoco.mjtObj.mjOBJ_SITE):
        return data.site_xpos[int(model.eq_obj1id[loop])], data.site_xpos[int(model.eq_obj2id[loop])]
    points = []
    for body, local in zip(_ends(model, loop), (model.eq_data[loop, :3], model.eq_data[loop, 3:6]), strict=True):
        points.append(data.xpos[body] + data.xmat[body].reshape(3, 3) @ local)
    return points[0], points[1]
