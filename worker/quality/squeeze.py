"""Contact forces that hold an object, and the commanded posture that makes a position-controlled hand exert them.

q_squeeze = q + Kp^-1 sum_i J_i^T f_i (Dexonomy), with f a non-negative combination of friction pyramid edges that
leaves no net wrench and whose normal components sum to a given force.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from worker.hands.jacobian import generalized_forces
from worker.hands.model import HandModel
from worker.quality.wrench_space import wrenches

Floats = NDArray[np.float64]

#: Weight of each edge's own size: spreads the load over contacts that would do equally well.
SPREAD: Final = 0.1
#: Weight of joint torques, the hardest one to exert being 1: prefers forces the hand is strong in.
TORQUE: Final = 0.05
#: Weight of the sum of normal forces: it is met closely, then exactly by scaling, balance or not.
SUM: Final = 10.0


@dataclass(frozen=True)
class Contacts:
    """C contacts of one grasp, object frame."""

    body: NDArray[np.int32]
    """(C,) body of the hand."""
    point: Floats
    """(C, 3) [m]"""
    normal: Floats
    """(C, 3) unit, into the object."""


@dataclass(frozen=True)
class Hold:
    """Forces of one grasp."""

    force: Floats
    """(C, 3) force of the hand on the object at each contact [N]."""
    torque: Floats
    """(D,) torque of the dofs that exerts them [N m or N]."""
    residual: float
    """Net wrench over the sum of normal forces, torques over the object's radius; 0: perfectly balanced."""


def hold(
    hand: HandModel,
    bodies: Floats,
    contacts: Contacts,
    *,
    total_normal_force: float,
    friction: float,
    centre: Floats,
    radius: float,
) -> Hold:
    """Balanced contact forces of one grasp within the hand's torque limits.

    Where the torques exceed a limit all forces shrink together, so the balance stays.

    Args:
        hand: the hand.
        bodies: (L, 7) body poses at the grasp.
        contacts: the contacts.
        total_normal_force: wanted sum of normal forces [N].
        friction: Coulomb coefficient of the pyramids.
        centre: (3,) torque origin [m].
        radius: torque scale [m].
    """
    if not len(contacts.body):
        return Hold(np.zeros((0, 3)), np.zeros(hand.dofs), 1.0)
    edge = wrenches(contacts.point, contacts.normal, friction=friction, centre=centre, radius=radius)
    torque = generalized_forces(hand, bodies, contacts.body, contacts.point, edge[..., :3])
    share = _shares(edge.reshape(-1, 6), torque.reshape(-1, hand.dofs) / hand.effort)
    residual = float(np.linalg.norm(share @ edge.reshape(-1, 6)))
    share = share.reshape(edge.shape[:2]) * total_normal_force
    wanted = np.einsum("ce,ced->d", share, torque)
    scale = min(1.0, 1.0 / max(1e-12, float((np.abs(wanted) / hand.effort).max())))
    return Hold(scale * np.einsum("ce,cej->cj", share, edge[..., :3]), scale * wanted, residual)


def _shares(edge: Floats, torque: Floats) -> Floats:
    """(K,) non-negative weights of K edge wrenches (K, 6), of sum 1 and without net wrench as nearly as can be.

    `torque` (K, D) are the dofs' torques over their limits, up to a common factor.
    """
    count = len(edge)
    effort = torque / max(1e-12, float(np.abs(torque).max()))
    system = np.vstack([edge.T, SUM * np.ones((1, count)), TORQUE * effort.T, SPREAD * np.eye(count)])
    target = np.zeros(len(system))
    target[6] = SUM
    share = nnls(system, target)[0]
    weights: Floats = share / max(float(share.sum()), 1e-12)
    return weights
