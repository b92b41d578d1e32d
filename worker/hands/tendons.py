"""Tendons: drives that pull several joints and command their sum; contact determines each share."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from graspd.service.model.errors import HandError
from graspd.service.model.transforms import Floats
from graspd.worker.hands.robot import Robot

#: Coefficients below this count as zero.
LEAST_PULL: Final = 1e-6
#: The outer joints of a Shadow finger: one tendon pulls J1 and J2. A URDF cannot state this.
_SHADOW: Final = re.compile(r"(?P<prefix>.*?)(?P<finger>FF|MF|RF|LF)J1")
_SHADOW_FINGERS: Final = frozenset({"FF", "MF", "RF"})


@dataclass(frozen=True)
class Tendon:
    """A drive of several dofs: its length is the sum of coefficient times joint value.
    A pull F exerts the torque c F on each joint at any joint value, so the drive controls only the sum."""

    name: str
    dofs: tuple[int, ...]
    coefficients: tuple[float, ...]

    def gain(self, stiffness: Floats) -> float:
        """Compute the drive's gain [N m/rad of length] from its dofs' gains (D,), in series: 1 / sum(c^2 / k).
        If each joint is commanded to q + c F / k, for a torque c F, the tendon then pulls with F."""
        parts = zip(self.dofs, self.coefficients, strict=True)
        return 1.0 / sum(c * c / float(stiffness[d]) for d, c in parts)

    def limit(self, effort: Floats) -> float:
        """Return the largest pull that exceeds no dof's limit (D,)."""
        return min(float(effort[d]) / abs(c) for d, c in zip(self.dofs, self.coefficients, strict=True))


def actuator_matrix(tendons: tuple[Tendon, ...], dofs: int) -> Floats:
    """Return the matrix (A, D) from dof values to drive lengths; a tendon has its first dof's place."""
    rows = np.eye(dofs)
    others: list[int] = []
    for tendon in tendons:
        first = min(tendon.dofs)
        rows[first] = 0.0
        rows[first, list(tendon.dofs)] = tendon.coefficients
        others += [d for d in tendon.dofs if d != first]
    return np.delete(rows, others, axis=0)


def tendons_of(
    robot: Robot, stated: Mapping[str, Mapping[str, float]] | None, dof_names: tuple[str, ...]
) -> tuple[Tendon, ...]:
    """Return a hand's tendons: stated ones, else those of the description, else those of a Shadow hand.
    Only joints that are degrees of freedom of the hand count; fewer than two make no tendon."""
    said = stated if stated is not None else robot.tendons or shadow_tendons(robot)
    found = []
    for name, pulls in said.items():
        kept = {joint: float(c) for joint, c in pulls.items() if joint in dof_names and abs(c) > LEAST_PULL}
        if len(kept) > 1:
            found.append(Tendon(name, tuple(dof_names.index(joint) for joint in kept), tuple(kept.values())))
    return tuple(found)


def shadow_tendons(robot: Robot) -> dict[str, dict[str, float]]:
    """Return the tendons of a hand with Shadow's joint names and order: J1 + J2 of all but the thumb."""
    found: dict[str, dict[str, float]] = {}
    fingers = set()
    for name, joint in robot.joints.items():
        outer = _SHADOW.fullmatch(name)
        if outer is None or joint.type != "revolute" or joint.mimic is not None:
            continue
        inner = robot.joints.get(f"{name[:-1]}2")
        if inner is not None and inner.type == "revolute" and inner.mimic is None and inner.child == joint.parent:
            found[f"{name[:-1]}0"] = {inner.name: 1.0, name: 1.0}
            fingers.add(outer["finger"])
    # MJCF defines its tendons itself.
    return found if fingers >= _SHADOW_FINGERS and robot.format == "URDF" else {}


def check_tendons(robot: Robot, stated: Mapping[str, Mapping[str, float]]) -> None:
    """Check stated tendons.
    Raises HandError: a tendon names an unknown joint or pulls fewer than two joints, or two tendons pull one joint."""
    seen: set[str] = set()
    for name, pulls in stated.items():
        for joint in pulls:
            if joint not in robot.joints or robot.joints[joint].type == "fixed":
                raise HandError(f"tendon {name!r} pulls {joint!r}, which is no moving joint of the hand")
            if joint in seen:
                raise HandError(f"joint {joint!r} is on two tendons; only one drive can move it")
            seen.add(joint)
        if sum(abs(c) > LEAST_PULL for c in pulls.values()) < 2:
            raise HandError(f"tendon {name!r} pulls fewer than two joints; leave it out")
