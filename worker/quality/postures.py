"""The postures around a grasp: before contact, fingers open and clear; and the commanded one that presses.

They decide more of a grasp's success than the optimiser does (Dexonomy, table VI).
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from worker.grasps import Posture
from worker.hands.kinematics import body_poses
from worker.hands.model import Floats, HandModel
from worker.objects.model import ObjectModel
from worker.quality.contact import choose_contacts, finger_of_body
from worker.quality.probe import Distances, Probe, probe_of
from worker.quality.squeeze import Contacts, Hold, hold
from worker.transforms import quat_rotate

#: Fingers open until this far from the object [m] (BODex).
CLEARANCE_M: Final = 0.010
#: The root retreats until the whole hand is this far away [m]: a palm left in touch kicks the object.
PALM_CLEARANCE_M: Final = 0.005
#: Opening steps of each finger [rad, or m for prismatic dofs], and their number.
OPENING_STEP: Final = 0.05
OPENING_STEPS: Final = 24
RETREATS_M: Final = (0.0, 0.0025, 0.005, 0.0075, 0.010, 0.015, 0.020)

#: Hand points within this of the object press on it [m].
PRESSING_M: Final = 0.003
#: Sum of the contact forces' normal components [N], and the Coulomb coefficient they are balanced with.
TOTAL_NORMAL_FORCE: Final = 50.0
FRICTION: Final = 0.6
MAX_PRESSING: Final = 16

_POINTS: Final = 600
_CHUNK: Final = 32


def pregrasp(hand: HandModel, obj: ObjectModel, grasp: Posture) -> Posture:
    """N postures from which the hand closes: every finger opened, against its closing direction, until its points are
    `CLEARANCE_M` away or its clearance is greatest; then the root moved back along the palm's approach, if the hand
    still is within `PALM_CLEARANCE_M`."""
    probe = probe_of(hand, obj, hand_points=_POINTS, object_points=64)
    parts = [_pregrasp(probe, _rows(grasp, i)) for i in range(0, len(grasp), _CHUNK)]
    return _join(hand, parts)


def squeeze(
    hand: HandModel,
    obj: ObjectModel,
    grasp: Posture,
    *,
    total_normal_force: float = TOTAL_NORMAL_FORCE,
    friction: float = FRICTION,
) -> Posture:
    """N commanded postures that press: q + Kp^-1 J^T f, the root unchanged; see `worker.quality.squeeze`."""
    holds = hold_forces(hand, obj, grasp, total_normal_force=total_normal_force, friction=friction)
    torque = np.array([h.torque for h in holds]).reshape(len(grasp), hand.dofs)
    q = hand.reduce(grasp.joint_positions) + torque / hand.stiffness
    return Posture(np.array(grasp.hand_pose, float), hand.expand(q))


def hold_forces(
    hand: HandModel,
    obj: ObjectModel,
    grasp: Posture,
    *,
    total_normal_force: float = TOTAL_NORMAL_FORCE,
    friction: float = FRICTION,
) -> list[Hold]:
    """Balanced contact forces of N grasps; `Hold.residual` predicts whether the grasp will hold."""
    probe = probe_of(hand, obj, hand_points=_POINTS, object_points=64)
    holds: list[Hold] = []
    for start in range(0, len(grasp), _CHUNK):
        found = probe.measure(_rows(grasp, start))
        for b in range(len(found.bodies)):
            contacts = _pressing(probe, found, b)
            holds.append(
                hold(
                    hand, found.bodies[b], contacts, total_normal_force=total_normal_force, friction=friction,
                    centre=obj.centre_of_mass, radius=obj.radius,
                )
            )  # fmt: skip
    return holds


def _pressing(probe: Probe, found: Distances, b: int) -> Contacts:
    near = probe.facing(found)[b] & (found.distance[b] < PRESSING_M)
    place, normal = found.closest[b], found.normal[b]
    chosen = choose_contacts(near, place, normal, scale=probe.obj.radius, limit=MAX_PRESSING)
    return Contacts(probe.points.body[chosen], place[chosen], -normal[chosen])


def _pregrasp(probe: Probe, grasp: Posture) -> Posture:
    hand = probe.hand
    q = hand.reduce(grasp.joint_positions)
    finger = finger_of_body(hand)
    paths = _openings(hand, q)
    clearance = _finger_clearance(probe, grasp.hand_pose, paths, finger)
    chosen = _first_clear(clearance, CLEARANCE_M)
    opened = q.copy()
    for d in range(hand.dofs):
        # A dof opens with the first finger that it drives; one that drives no finger stays.
        driven = finger[np.flatnonzero(hand.dof == d)]
        if (driven >= 0).any():
            steps = chosen[:, driven[driven >= 0][0]]
            opened[:, d] = paths[np.arange(len(q)), steps, d]
    return _retreat(probe, grasp.hand_pose, opened)


def _openings(hand: HandModel, q: Floats) -> Floats:
    """(B, K, D) dof values on the way open, the grasp first, all within the limits."""
    step = OPENING_STEP * np.arange(OPENING_STEPS + 1)
    path = q[:, None] - step[None, :, None] * hand.closing
    # A grasp may stand a hair outside its limits: opening must not make a jump of that.
    return np.clip(path, np.minimum(hand.lower, q)[:, None], np.maximum(hand.upper, q)[:, None])


def _finger_clearance(probe: Probe, hand_pose: Floats, paths: Floats, finger: NDArray[np.int32]) -> Floats:
    """(B, K, fingers) least distance of each finger's points to the object; inf where a finger has none."""
    count, steps, _ = paths.shape
    joints = probe.hand.expand(paths).reshape(count * steps, -1)
    distance = _distances(probe, np.repeat(hand_pose, steps, axis=0), joints)
    out = np.full((count * steps, max(1, len(probe.hand.fingertips))), np.inf)
    for f in range(out.shape[1]):
        mine = finger[probe.points.body] == f
        if mine.any():
            out[:, f] = distance[:, mine].min(axis=1)
    return out.reshape(count, steps, -1)


def _distances(probe: Probe, hand_pose: Floats, joints: Floats) -> Floats:
    points = probe.posed_points(body_poses(probe.hand, hand_pose, joints))
    return probe.signed_distance(points.reshape(-1, 3))[0].reshape(points.shape[:2])


def _first_clear(clearance: Floats, wanted: float) -> NDArray[np.intp]:
    """Index along axis 1 of the first clearance that is enough, or of the greatest."""
    enough = clearance >= wanted
    return np.where(enough.any(axis=1), enough.argmax(axis=1), clearance.argmax(axis=1))


def _retreat(probe: Probe, hand_pose: Floats, q: Floats) -> Posture:
    count, choices = len(q), len(RETREATS_M)
    back = -quat_rotate(hand_pose[:, 3:], probe.hand.palm.approach)
    poses = np.repeat(hand_pose[:, None], choices, axis=1)
    poses[..., :3] += np.array(RETREATS_M)[None, :, None] * back[:, None]
    joints = probe.hand.expand(q)
    distance = _distances(probe, poses.reshape(-1, 7), np.repeat(joints, choices, axis=0))
    chosen = _first_clear(distance.min(axis=1).reshape(count, choices), PALM_CLEARANCE_M)
    return Posture(poses[np.arange(count), chosen], joints)


def _rows(posture: Posture, start: int) -> Posture:
    rows = slice(start, start + _CHUNK)
    return Posture(np.asarray(posture.hand_pose, float)[rows], np.asarray(posture.joint_positions, float)[rows])


def _join(hand: HandModel, parts: list[Posture]) -> Posture:
    return Posture(
        np.concatenate([np.zeros((0, 7)), *(p.hand_pose for p in parts)]),
        np.concatenate([np.zeros((0, len(hand.joint_names))), *(p.joint_positions for p in parts)]),
    )
