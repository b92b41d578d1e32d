"""Which joints of an MJCF model follow others: by joint equalities, fixed tendons, and closed loops."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import mujoco
import numpy as np

from worker.hands.mjcf_loops import follow_loops
from worker.hands.mjcf_servos import driven, joints_on_tendon
from worker.hands.robot import Mimic

_RANGE_POINTS: Final = 41
#: Coefficients of the joints that a tendon pulls, by the name of its drive.
Tendons = dict[str, dict[int, float]]


@dataclass(frozen=True)
class Couplings:
    """How the joints of a model hang together."""

    follows: dict[int, Mimic | float]
    """What each dependent joint follows, or the value at which an equality holds it."""
    notes: list[str]
    """What a user must know."""
    tendons: Tendons
    faults: dict[int, str]
    """Joints whose loop is not solved, and why."""


def couplings(model: Any, name: Callable[[int], str]) -> Couplings:
    """Those of a compiled model; `name` tells the name of a joint."""
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
    """What follows a joint that stands still, stands still."""
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
    """first - first0 = p(second - second0), p of degree 4; bent ones are replaced by the line that fits best."""
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
    """Whether a joint follows another one, at the end of whatever chain."""
    number = {name(j): j for j in found}
    while isinstance(follows := found.get(joint), Mimic):
        if follows.joint == name(first):
            return True
        joint = number.get(follows.joint, -1)
    return False


def _couple_tendons(
    model: Any, equality: int, one: tuple[int, float], other: tuple[int, float], found: dict[int, Mimic | float],
    name: Callable[[int], str],
) -> str:  # fmt: skip
    """The same for tendons of one joint each: c1 (q1 - q1_0) = p(c2 (q2 - q2_0))."""
    scaled = np.asarray(model.eq_data[equality, :5]) * other[1] ** np.arange(5) / one[1]
    return _couple(model, one[0], other[0], scaled, found, name)


def _couple_on_tendon(
    model: Any, equality: int, pulled: list[tuple[int, float]], found: dict[int, Mimic | float],
    name: Callable[[int], str],
) -> str:  # fmt: skip
    """Two joints on a tendon of fixed length: c1 (q1 - q1_0) + c2 (q2 - q2_0) = p0. What no actuator moves, follows.

    Limits go before the tendon: where they stop the follower it stays, as in a finger whose end gives way.
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
    """Joints that share one actuated tendon, unless something else moves them: notes, and tendons.

    Joints of one finger, each on the one before, share it as what they touch says. Joints side by side, the jaws of a
    gripper, bend in the ratio of its pull on them: free to share it they would let the object run from side to side.
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
    """Whether each joint moves the next, or the next moves it, all the way."""
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
