"""Contact forces that hold an object, and the commanded posture that makes a position-controlled hand exert them.

q_squeeze = q + Kp^-1 sum_i J_i^T f_i (Dexonomy), with f a non-negative combination of friction pyramid edges that
leaves no net wrench and whose normal components sum to a given force.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from worker.hands.jacobian import generalized_forces
from worker.hands.model import HandModel
from worker.quality.balance import nonnegative_weights
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


def balanced(
    hand: HandModel,
    bodies: Floats,
    contacts: Sequence[Contacts],
    *,
    total_normal_force: float,
    friction: float,
    centre: Floats,
    radius: float,
) -> list[Hold]:
    """Balanced contact forces of B grasps within the hand's torque limits.

    Where the torques exceed a limit all forces shrink together, so the balance stays.

    Args:
        hand: the hand.
        bodies: (B, L, 7) body poses at each grasp.
        contacts: the contacts of each.
        total_normal_force: wanted sum of normal forces [N].
        friction: Coulomb coefficient of the pyramids.
        centre: (3,) torque origin [m].
        radius: torque scale [m].
    """
    count = np.array([len(some.body) for some in contacts], int)
    most = int(count.max(initial=0))
    if not most:
        return [Hold(np.zeros((0, 3)), np.zeros(hand.dofs), 1.0) for _ in contacts]
    body, point, normal = _padded(contacts, most)
    edge = wrenches(point, normal, friction=friction, centre=centre, radius=radius)
    torque = generalized_forces(hand, bodies, body, point, edge[..., :3])
    share = _shares(edge, torque / hand.effort, count)
    residual = np.linalg.norm(np.einsum("bce,bcew->bw", share, edge), axis=1)
    share *= total_normal_force
    wanted = np.einsum("bce,bced->bd", share, torque)
    scale = np.minimum(1.0, 1.0 / np.maximum(1e-12, (np.abs(wanted) / hand.effort).max(axis=1)))
    force = scale[:, None, None] * np.einsum("bce,bcej->bcj", share, edge[..., :3])
    return [
        Hold(force[b, : count[b]], scale[b] * wanted[b], float(residual[b]) if count[b] else 1.0)
        for b in range(len(count))
    ]


def _padded(contacts: Sequence[Contacts], most: int) -> tuple[NDArray[np.intp], Floats, Floats]:
    """Body (B, C), point and normal (B, C, 3) of all contacts; those that a grasp lacks have normal z."""
    body = np.zeros((len(contacts), most), np.intp)
    point, normal = np.zeros((len(contacts), most, 3)), np.tile([0.0, 0, 1], (len(contacts), most, 1))
    for b, some in enumerate(contacts):
        body[b, : len(some.body)], point[b, : len(some.body)] = some.body, some.point
        normal[b, : len(some.body)] = some.normal
    return body, point, normal


def _shares(edge: Floats, torque: Floats, count: NDArray[np.intp]) -> Floats:
    """(B, C, E) non-negative weights of the edge wrenches (B, C, E, 6) of `count` (B,) contacts: of sum 1, and without
    net wrench as nearly as can be.

    `torque` (B, C, E, D) are the dofs' torques over their limits, up to a common factor.
    """
    used = np.arange(edge.shape[1]) < count[:, None]
    largest = np.abs(np.where(used[..., None, None], torque, 0.0)).max(axis=(1, 2, 3))
    effort = torque / np.maximum(1e-12, largest)[:, None, None, None]
    columns = np.concatenate([edge, np.full((*edge.shape[:3], 1), SUM), TORQUE * effort], axis=-1)
    target = np.zeros(columns.shape[-1])
    target[6] = SUM
    flat = columns.reshape(len(edge), -1, columns.shape[-1])
    share = nonnegative_weights(flat, target, SPREAD, count * edge.shape[2])
    weights: Floats = share / np.maximum(share.sum(axis=1), 1e-12)[:, None]
    return weights.reshape(edge.shape[:3])
