"""Closed loops of an MJCF model: the joints that nothing drives, as lines of those that do.

A four-bar linkage is a tree whose ends `connect` constraints hold together. The loops are solved at values over the
drivers' ranges, and each passive joint becomes a line of its driver, with the error that this leaves.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import mujoco
import numpy as np

from service.model.errors import HandError
from service.model.transforms import Floats
from worker.hands.mjcf_servos import driven
from worker.hands.robot import Mimic

_STEPS: Final = 33
_ROUNDS: Final = 60
#: Ends of a loop that stay further apart than this do not meet [m].
_OPEN_M: Final = 2e-4
_ONE_VALUE: Final = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
#: A passive joint that leaves its line by more than this does not follow it [rad].
MAX_ERROR_RAD: Final = 0.08


def follow_loops(
    model: Any, found: dict[int, Mimic | float], name: Callable[[int], str]
) -> tuple[list[str], dict[int, str]]:
    """Add to `found` the joints that close the loops of a model.

    Returns:
        notes for the user; and joints whose loop is not solved, with the refusal of a hand that moves by them.
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
            # It only matters where the hand moves by it.
            faults |= dict.fromkeys(passive, str(error))
    return notes, faults


def _follow(
    model: Any, group: list[int], joints: list[int], passive: list[int], actuated: set[int],
    found: dict[int, Mimic | float], name: Callable[[int], str],
) -> str:  # fmt: skip
    """Add to `found` what the passive joints of a group of loops follow; a note.

    Raises:
        HandError: it has no driver or several, does not close over the range of its driver, or its joints follow no
            line.
    """
    held = ", ".join(map(name, joints))
    if round_ones := [j for j in joints if int(model.jnt_type[j]) not in _ONE_VALUE]:
        raise HandError(
            f"the loop of {held} turns on {name(round_ones[0])}, which is no hinge or slide joint, and is not solved; "
            "write equalities of joints instead of the loop"
        )
    drivers = [j for j in joints if j in actuated and j not in found]
    if not drivers:
        # Those that follow others move as these do.
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
    """Loops that share joints belong together."""
    groups: list[tuple[set[int], list[int]]] = []
    for loop in loops:
        joints = set(_on_loop(model, loop))
        touching = [group for group in groups if group[0] & joints]
        merged = (joints.union(*(g[0] for g in touching)), [e for g in touching for e in g[1]] + [loop])
        groups = [group for group in groups if group not in touching] + [merged]
    return [members for _, members in groups]


def _ends(model: Any, loop: int) -> tuple[int, int]:
    """Bodies that a connect constraint holds together."""
    first, second = int(model.eq_obj1id[loop]), int(model.eq_obj2id[loop])
    if model.eq_objtype[loop] == int(mujoco.mjtObj.mjOBJ_SITE):
        return int(model.site_bodyid[first]), int(model.site_bodyid[second])
    return first, max(second, 0)


def _on_loop(model: Any, loop: int) -> list[int]:
    """Joints between the ends and the body at which their chains part."""
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
    """(S,) values of the driver and (S, P) values of the passive joints at which the loops are closed."""
    data = mujoco.MjData(model)
    lower, upper = map(float, model.jnt_range[driver]) if model.jnt_limited[driver] else (-np.pi, np.pi)
    start = float(np.clip(model.qpos0[model.jnt_qposadr[driver]], lower, upper))
    values = np.linspace(lower, upper, _STEPS)
    # From where the model is written to both ends, each step from the solution of the last.
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
    """Passive joint values that close the loops at a value of the driver (Gauss-Newton), and the gap left [m]."""
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
    """The two points, in the world, that a connect constraint holds together."""
    if model.eq_objtype[loop] == int(mujoco.mjtObj.mjOBJ_SITE):
        return data.site_xpos[int(model.eq_obj1id[loop])], data.site_xpos[int(model.eq_obj2id[loop])]
    points = []
    for body, local in zip(_ends(model, loop), (model.eq_data[loop, :3], model.eq_data[loop, 3:6]), strict=True):
        points.append(data.xpos[body] + data.xmat[body].reshape(3, 3) @ local)
    return points[0], points[1]
