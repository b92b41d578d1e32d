"""Force limits and position gains of the joints of an MJCF model, from its actuators."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from graspd.worker.hands.robot import Mimic


@dataclass(frozen=True)
class Servo:
    """Drive of a joint; 0: not stated."""

    effort: float = 0.0
    """[N m or N]"""
    stiffness: float = 0.0
    """[N m/rad or N/m]"""


def servos(model: Any, mimics: Mapping[int, Mimic | float], shared: Collection[int] = ()) -> dict[int, Servo]:
    """Return the servo of each joint that an actuator drives.

    An actuator of gear g on a length l pulls with g F dl/dq at joint q. A position servo of gain k holds the joint with
    k (g dl/dq)^2. On a joint dl/dq is 1. On a fixed tendon it is the joint's coefficient plus those of its followers
    times their rates. Each of n joints that share a tendon (`shared`) is as stiff as n such joints in series must be
    for the tendon's gain.
    """
    found: dict[int, Servo] = {}
    joint_of = {str(model.joint(j).name): j for j in range(model.njnt)}
    for actuator in range(model.nu):
        gear = float(model.actuator_gear[actuator, 0])
        rates: dict[int, float] = {}
        for joint, coefficient in driven(model, actuator):
            driver, rate = _driver(joint, mimics, joint_of)
            if driver is not None:
                rates[driver] = rates.get(driver, 0.0) + coefficient * rate
        for joint, rate in rates.items():
            arm = abs(gear * rate)
            force, gain = _force(model, actuator), _gain(model, actuator)
            gain *= len(rates) if joint in shared else 1
            before = found.get(joint, Servo())
            found[joint] = Servo(before.effort + arm * force, before.stiffness + arm**2 * gain)
    for joint, servo in list(found.items()):
        if model.jnt_actfrclimited[joint]:
            most = float(np.abs(model.jnt_actfrcrange[joint]).max())
            found[joint] = Servo(min(servo.effort, most) or most, servo.stiffness)
    return found


def commanded(model: Any) -> dict[int, tuple[float, float]]:
    """Return the command range of a joint's position servo: g k (u - q) with u in its control range."""
    found = {}
    for actuator in range(model.nu):
        kind, gain = int(model.actuator_trntype[actuator]), _gain(model, actuator)
        gear = float(model.actuator_gear[actuator, 0])
        if kind != int(mujoco.mjtTrn.mjTRN_JOINT) or gain <= 0 or not gear or not model.actuator_ctrllimited[actuator]:
            continue
        told = float(model.actuator_gainprm[actuator, 0]) * np.asarray(model.actuator_ctrlrange[actuator], float)
        ends = (told + float(model.actuator_biasprm[actuator, 0])) / (gain * gear)
        if np.ptp(ends) > 1e-6:
            found[int(model.actuator_trnid[actuator, 0])] = float(ends.min()), float(ends.max())
    return found


def driven(model: Any, actuator: int) -> list[tuple[int, float]]:
    """Return the joints that an actuator moves, with the rate at which its length changes with each."""
    kind, target = int(model.actuator_trntype[actuator]), int(model.actuator_trnid[actuator, 0])
    if kind in (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)):
        return [(target, 1.0)]
    return joints_on_tendon(model, target) if kind == int(mujoco.mjtTrn.mjTRN_TENDON) else []


def joints_on_tendon(model: Any, tendon: int) -> list[tuple[int, float]]:
    """Return the joints of a fixed tendon with their coefficients."""
    first, count = int(model.tendon_adr[tendon]), int(model.tendon_num[tendon])
    return [
        (int(model.wrap_objid[w]), float(model.wrap_prm[w]))
        for w in range(first, first + count)
        if model.wrap_type[w] == int(mujoco.mjtWrap.mjWRAP_JOINT)
    ]


def _driver(joint: int, mimics: Mapping[int, Mimic | float], joint_of: Mapping[str, int]) -> tuple[int | None, float]:
    """Return the joint at the end of a chain of mimics, and the total rate."""
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


def _force(model: Any, actuator: int) -> float:
    """Return the largest force; 0 if the model states none."""
    if model.actuator_forcelimited[actuator]:
        return float(np.abs(model.actuator_forcerange[actuator]).max())
    if model.actuator_ctrllimited[actuator] and model.actuator_biastype[actuator] == int(mujoco.mjtBias.mjBIAS_NONE):
        return abs(float(model.actuator_gainprm[actuator, 0])) * float(np.abs(model.actuator_ctrlrange[actuator]).max())
    return 0.0


def _gain(model: Any, actuator: int) -> float:
    """Return the gain of a position servo; 0 for other actuators."""
    if model.actuator_biastype[actuator] != int(mujoco.mjtBias.mjBIAS_AFFINE):
        return 0.0
    return max(0.0, -float(model.actuator_biasprm[actuator, 1]))
