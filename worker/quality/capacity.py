"""Load capacity of grasps: the heaviest object that contact forces could bear within actuator limits and friction.

A linear program for each grasp: contact forces inside friction pyramids balance the weight and all torques about the
centre of mass, and no drive exceeds its effort. A bound from above: it chooses the forces as no controller can, and its
pyramids enclose the cones. What presses against the palm, across joints, or towards a joint's stop costs no effort.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from service.model.matter import ACCELERATION
from service.model.transforms import Floats, cross
from worker.grasps import Posture
from worker.hands.kinematics import generalized_forces
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel
from worker.quality.contact import choose_contacts
from worker.quality.posed import posing_of
from worker.quality.wrench_space import EDGES, cone_edges

_POINTS: Final = 600
#: Hand points that are nearer may come to press while the hand closes [m]; as many at most, those that spread most.
WITHIN_M: Final = 0.01
MOST: Final = 32
#: A joint that is nearer to its limit, as a share of its range, rests on its stop.
AT_STOP: Final = 0.02
#: Result of `linprog`.
_UNBOUNDED: Final = 3


def capacities(hand: HandModel, obj: ObjectModel, grasp: Posture, against: Floats) -> Floats:
    """(N,) heaviest mass [kg] that N grasps could bear; 0: nothing touches; inf: no drive and no friction limits it.

    Args:
        hand: the hand.
        obj: the object, with its friction.
        grasp: N postures at contact.
        against: (N, K, 3) unit vectors against the weight; the least of K counts.
    """
    probe = posing_of(hand, obj, points=_POINTS).probe
    found = probe.touch(grasp)
    facing = (found.distance < WITHIN_M) & probe.facing(found)
    q = hand.reduce(grasp.joint_positions)
    out = np.zeros(len(grasp))
    for row in range(len(grasp)):
        chosen = choose_contacts(facing[row], found.closest[row], found.normal[row], scale=obj.radius, limit=MOST)
        if not len(chosen):
            continue
        points = found.closest[row, chosen]
        forces = cone_edges(-found.normal[row, chosen], obj.friction / math.cos(math.pi / EDGES))
        torques = generalized_forces(hand, found.bodies[row], probe.points.body[chosen], points, -forces)
        moments = cross((points - obj.centre_of_mass)[:, None] / obj.radius, forces)
        efforts = _limits(hand, q[row])
        loads = [
            _load(forces.reshape(-1, 3), moments.reshape(-1, 3), torques.reshape(-1, hand.dofs), efforts, along)
            for along in against[row]
        ]
        out[row] = min(loads) / ACCELERATION
    return out


def _limits(hand: HandModel, q: Floats) -> Floats:
    """(2 D,) what contacts may exert on each dof upwards, then downwards [N m or N]: beyond a stop anything."""
    near = AT_STOP * hand.span
    up = np.where(q > hand.upper - near, np.inf, hand.effort)
    return np.concatenate([up, np.where(q < hand.lower + near, np.inf, hand.effort)])


def _load(forces: Floats, moments: Floats, torques: Floats, efforts: Floats, along: Floats) -> float:
    """Largest weight [N] that edges of pyramids, of forces (E, 3), moments (E, 3) and torques (E, D), balance."""
    from scipy.optimize import linprog

    count = len(forces)
    balance = np.column_stack([np.hstack([forces, moments]).T, -np.concatenate([along, np.zeros(3)])])
    exerted = np.column_stack([np.vstack([torques.T, -torques.T]), np.zeros(len(efforts))])
    limited = np.isfinite(efforts)
    solved = linprog(
        np.append(np.zeros(count), -1.0),
        A_ub=exerted[limited],
        b_ub=efforts[limited],
        A_eq=balance,
        b_eq=np.zeros(6),
        bounds=(0, None),
    )
    if solved.status == _UNBOUNDED:
        return math.inf
    return -float(solved.fun) if solved.fun is not None else 0.0
