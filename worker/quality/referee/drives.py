"""Drives of a hand in MuJoCo: which joint carries a dof's actuator, and actuators on tendons."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from service.model.transforms import Floats
from worker.hands.model import HandModel
from worker.hands.tendons import Tendon


def leading_joints(hand: HandModel) -> tuple[Floats, Floats]:
    """Multiplier and offset of the first body that each dof drives."""
    first = leading_bodies(hand)
    return hand.multiplier[first], hand.offset[first]


def leading_bodies(hand: HandModel) -> NDArray[np.intp]:
    """(D,) the body whose joint carries each dof's actuator: of the first joint it drives, as `HandModel.reduce`."""
    drives = hand.dof[hand.joint_body]
    return np.array([hand.joint_body[int(np.flatnonzero(drives == d)[0])] for d in range(hand.dofs)], np.intp)


def add_tendon(spec: Any, hand: HandModel, tendon: Tendon, name: str, leading: NDArray[np.intp]) -> None:
    """One actuator on the sum of joints; nothing else holds them to each other."""
    cord = spec.add_tendon(name=name)
    for d, pull in zip(tendon.dofs, tendon.coefficients, strict=True):
        cord.wrap_joint(f"joint{leading[d]}", pull)
    actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_TENDON)
    actuator.set_to_position(kp=tendon.gain(hand.stiffness))
    limit = tendon.limit(hand.effort)
    actuator.forcerange = [-limit, limit]
    actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE


def equality_data(*values: float) -> Floats:
    data = np.zeros(mujoco.mjNEQDATA)
    data[: len(values)] = values
    return data
