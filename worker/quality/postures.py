"""The postures around a grasp: before contact, fingers open and clear; and the commanded one that presses.

They decide more of a grasp's success than the optimiser does (Dexonomy, table VI).
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from service.model.transforms import quat_rotate
from worker.grasps import Posture
from worker.hands.jacobian import generalized_forces
from worker.hands.jaws import jaws_of, slides
from worker.hands.model import Floats, HandModel
from worker.objects.model import ObjectModel
from worker.quality.contact import choose_contacts, finger_of_body
from worker.quality.jaw_squeeze import jaw_squeeze
from worker.quality.probe import Probe, Touch, probe_of
from worker.quality.raising import raised
from worker.quality.squeeze import Contacts, Hold, balanced
from worker.simulation.obstacles import body_room
from worker.simulation.surroundings import Placed

#: Fingers open until this far from the object [m]: enough for the errors of a calibrated arm, and what opens farther
#: comes back faster and kicks the object away more often.
CLEARANCE_M: Final = 0.005
#: A finger that cannot get this far along its contact normals opens plainly [m].
STUCK_M: Final = 0.003
#: The root retreats only where the open hand is nearer than this [m]: a palm left in touch kicks the object, but so
#: does one that comes back from afar while the fingers close.
PALM_CLEARANCE_M: Final = 0.0005
#: Share of plain opening, against `HandModel.closing`, in the way a finger leaves; the rest is along the contact
#: normals, so that the finger comes back without dragging the object along.
PLAIN_OPENING: Final = 0.3
#: Opening steps of each finger [rad], of sliding ones [m], and their number.
OPENING_STEP: Final = 0.05
SLIDING_STEP_M: Final = 0.002
OPENING_STEPS: Final = 24
#: A finger may run into the rest of the hand by this much more than it does in the grasp [m]; it is looked at in these
#: shares of its way, and one that jams opens half as far, at the last of so many looks not at all.
JAM_M: Final = 5e-4
WAY: Final = (1 / 3, 2 / 3, 1.0)
JAM_LOOKS: Final = 4
#: Distance that opening fingers keep from obstacles [m].
ROOM_M: Final = 0.0025
#: Share of its range by which a joint opens beyond the pregrasp for the way in: fingers that reach around the object
#: would sweep it away.
WIDE: Final = 0.4
RETREATS_M: Final = (0.0, 0.0025, 0.005, 0.0075, 0.010, 0.015, 0.020)

#: Hand points within this of the object press on it [m].
PRESSING_M: Final = 0.003
#: Sum of the contact forces' normal components [N], and the Coulomb coefficient they are balanced with: less than that
#: of what is held, for forces at the edge of their cones slip as soon as a contact is not quite where it was thought.
TOTAL_NORMAL_FORCE: Final = 50.0
FRICTION: Final = 0.3
MAX_PRESSING: Final = 16

_POINTS: Final = 600
#: Steps of its way that a finger is looked at together: most are clear after one or two.
_LOOK_STEPS: Final = 3
_CHUNK: Final = 32


def pregrasp(hand: HandModel, obj: ObjectModel, grasp: Posture, placed: Placed | None = None) -> Posture:
    """N postures from which the hand closes.

    Every finger leaves the object along its contact normals until its points are `CLEARANCE_M` away, or as far as it
    can get without running into other fingers or, where the grasps are `placed`, an obstacle of their scene; then the
    root moves back along the palm's approach if the hand is still in touch, and up where fingers would dip into what
    they may touch.
    """
    probe = probe_of(hand, obj, hand_points=_POINTS, object_points=64)
    starts = range(0, len(grasp), _CHUNK)
    scenes = [placed.take(slice(i, i + _CHUNK)) if placed is not None else None for i in starts]
    found = _join(hand, [_pregrasp(probe, _rows(grasp, i), scene) for i, scene in zip(starts, scenes, strict=True)])
    return found if placed is None else raised(hand, grasp, found, placed)


def wide_open(hand: HandModel, obj: ObjectModel, pregrasp: Posture, placed: Placed) -> Floats:
    """(N, J) joint positions in which a hand comes to its pregrasp: fingers plainly opened as far as `WIDE` of their
    range, or until they would run into one another or into an obstacle."""
    probe = probe_of(hand, obj, hand_points=_POINTS, object_points=64)
    parts = []
    for start in range(0, len(pregrasp), _CHUNK):
        rows, scene = _rows(pregrasp, start), placed.take(slice(start, start + _CHUNK))
        q = hand.reduce(rows.joint_positions)
        far = np.where(hand.closing > 0, hand.lower, np.where(hand.closing < 0, hand.upper, q))
        wide = np.where(_finger_of_dof(hand) >= 0, q + np.clip(far - q, -WIDE * hand.span, WIDE * hand.span), q)
        parts.append(hand.expand(_without_jams(probe, rows.hand_pose, q, wide, scene)))
    return np.concatenate([np.zeros((0, len(hand.joint_names))), *parts])


def squeeze(
    hand: HandModel,
    obj: ObjectModel,
    grasp: Posture,
    *,
    total_normal_force: float = TOTAL_NORMAL_FORCE,
    friction: float = FRICTION,
) -> Posture:
    """N commanded postures that press: q + Kp^-1 J^T f, the root unchanged; see `worker.quality.squeeze`."""
    if (jaws := jaws_of(hand)) is not None:
        probe = probe_of(hand, obj, hand_points=_POINTS, object_points=64)
        return jaw_squeeze(probe, jaws, grasp, total_normal_force=total_normal_force)
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
        found = probe.touch(_rows(grasp, start), reach=PRESSING_M)
        holds += balanced(
            hand, found.bodies, _pressing(probe, found), total_normal_force=total_normal_force, friction=friction,
            centre=obj.centre_of_mass, radius=obj.radius,
        )  # fmt: skip
    return holds


def _pressing(probe: Probe, found: Touch) -> list[Contacts]:
    """The contacts of each grasp that press."""
    near = probe.facing(found) & (found.distance < PRESSING_M)
    contacts = []
    for mask, place, normal in zip(near, found.closest, found.normal, strict=True):
        chosen = choose_contacts(mask, place, normal, scale=probe.obj.radius, limit=MAX_PRESSING)
        contacts.append(Contacts(probe.points.body[chosen], place[chosen], -normal[chosen]))
    return contacts


def _pregrasp(probe: Probe, grasp: Posture, placed: Placed | None) -> Posture:
    hand = probe.hand
    q = hand.reduce(grasp.joint_positions)
    finger = _finger_of_dof(hand)
    paths = _openings(hand, q, _leaving(probe, probe.touch(grasp, reach=CLEARANCE_M), finger))
    clearance = _finger_clearance(probe, grasp.hand_pose, paths)
    stuck = np.flatnonzero((clearance.max(axis=1) < STUCK_M).any(axis=1))
    if len(stuck):
        # Deep or enclosed fingers have no sensible normals: plain opening, where that gets them farther.
        plain = _openings(hand, q[stuck], np.tile(-hand.closing.astype(float), (len(stuck), 1)))
        other = _finger_clearance(probe, grasp.hand_pose[stuck], plain)
        better = other.max(axis=1) > np.minimum(clearance[stuck].max(axis=1), STUCK_M)
        clearance[stuck] = np.where(better[:, None], other, clearance[stuck])
        paths[stuck] = np.where(better[:, np.maximum(finger, 0)][:, None], plain, paths[stuck])
    chosen = _first_clear(clearance, CLEARANCE_M)
    opened = q.copy()
    for d in np.flatnonzero(finger >= 0):
        opened[:, d] = paths[np.arange(len(q)), chosen[:, finger[d]], d]
    return _retreat(probe, grasp.hand_pose, _without_jams(probe, grasp.hand_pose, q, opened, placed))


def _finger_of_dof(hand: HandModel) -> NDArray[np.int32]:
    """(D,) the first finger that each dof drives; -1: none, so it stays when fingers open."""
    finger = _finger_of_body(hand)
    driven = [finger[np.flatnonzero((hand.dof == d) & (finger >= 0))] for d in range(hand.dofs)]
    return np.array([f[0] if len(f) else -1 for f in driven], np.int32)


def _finger_of_body(hand: HandModel) -> NDArray[np.int32]:
    """(L,) what opens as one: a finger, as `finger_of_body` has them; of a gripper all that one dof moves."""
    if jaws_of(hand) is None:
        return finger_of_body(hand)
    out = np.full(hand.bodies, -1, np.int32)
    for body in range(1, hand.bodies):
        out[body] = out[hand.parent[body]] if out[hand.parent[body]] >= 0 else hand.dof[body]
    return out


def _fingers(hand: HandModel) -> int:
    """Size of arrays by finger."""
    return max(1, len(hand.fingertips), int(_finger_of_body(hand).max()) + 1)


def _leaving(probe: Probe, found: Touch, finger: NDArray[np.int32]) -> Floats:
    """(B, D) directions in which fingers leave the object; the fastest dof of each finger has about 1."""
    hand = probe.hand
    out = np.tile(-np.asarray(hand.closing, float), (len(found.bodies), 1))
    weight = np.clip(CLEARANCE_M - found.distance, 0.0, None)
    for b in range(len(out)):
        near = np.flatnonzero(weight[b] > 0)
        force = (weight[b, near, None] * found.normal[b, near])[:, None]
        body, points = probe.points.body[near], found.hand_points[b, near]
        away = generalized_forces(hand, found.bodies[b], body, points, force).sum(axis=(0, 1))
        for f in np.unique(finger[finger >= 0]):
            mine = np.flatnonzero(finger == f)
            # A finger that hooks around an edge would leave by closing further: it must open all the same.
            away[mine] = np.where(away[mine] * hand.closing[mine] > 0, 0.0, away[mine])
            fastest = float(np.abs(away[mine]).max())
            if fastest > 0:
                out[b, mine] = PLAIN_OPENING * out[b, mine] + (1 - PLAIN_OPENING) * away[mine] / fastest
    return out


def _openings(hand: HandModel, q: Floats, direction: Floats) -> Floats:
    """(B, K, D) dof values on the way along `direction` (B, D), the grasp first, all within the limits."""
    step = OPENING_STEP * np.arange(OPENING_STEPS + 1)
    direction = direction * np.where(slides(hand), SLIDING_STEP_M / OPENING_STEP, 1.0)
    path = q[:, None] + step[None, :, None] * direction[:, None]
    # A grasp may stand a hair outside its limits: opening must not make a jump of that.
    return np.clip(path, np.minimum(hand.lower, q)[:, None], np.maximum(hand.upper, q)[:, None])


def _finger_clearance(probe: Probe, hand_pose: Floats, paths: Floats) -> Floats:
    """(B, K, fingers) least distance of each finger's points to the object, at most `CLEARANCE_M`; inf where a finger
    has none.

    A hand whose fingers have all been `CLEARANCE_M` away is not looked at farther on its way: -inf there.
    """
    count, steps, _ = paths.shape
    finger = _finger_of_body(probe.hand)
    out = np.full((count, steps, _fingers(probe.hand)), -np.inf)
    going = np.arange(count)
    for first in range(0, steps, _LOOK_STEPS):
        look = paths[going, first : first + _LOOK_STEPS]
        joints = probe.hand.expand(look).reshape(-1, len(probe.hand.joint_names))
        poses = np.repeat(hand_pose[going], look.shape[1], axis=0)
        gaps = probe.body_gaps(poses, joints, reach=CLEARANCE_M)
        found = np.full((len(gaps), out.shape[2]), np.inf)
        for f in range(out.shape[2]):
            mine = finger == f
            if mine.any():
                found[:, f] = gaps[:, mine].min(axis=1)
        out[going, first : first + _LOOK_STEPS] = found.reshape(len(going), look.shape[1], -1)
        going = going[(out[going].max(axis=1) < CLEARANCE_M).any(axis=1)]
        if not len(going):
            break
    return out


def _first_clear(clearance: Floats, wanted: float) -> NDArray[np.intp]:
    """Index along axis 1 of the first clearance that is enough, or of the greatest."""
    enough = clearance >= wanted
    return np.where(enough.any(axis=1), enough.argmax(axis=1), clearance.argmax(axis=1))


def _without_jams(probe: Probe, hand_pose: Floats, q: Floats, opened: Floats, placed: Placed | None = None) -> Floats:
    """(B, D) the postures `opened`, fingers held back towards the grasp q where they would run into one another or
    into an obstacle.

    Fingers that jam never reach the grasp when they close again.
    """
    finger = _finger_of_dof(probe.hand)
    limit = _finger_depth(probe, hand_pose, q[:, None]) + JAM_M
    # A finger may stand nearer to an obstacle in the grasp than it should: opening must not bring it nearer still.
    room = None if placed is None else np.minimum(_finger_room(probe.hand, hand_pose, q[:, None], placed), ROOM_M)
    share = np.ones_like(limit)
    rows = np.arange(len(q))
    for look in range(JAM_LOOKS):
        move = (opened - q)[rows] * np.where(finger >= 0, share[rows][:, finger], 1.0)
        way = q[rows, None] + np.array(WAY)[None, :, None] * move[:, None]
        jammed = _finger_depth(probe, hand_pose[rows], way) > limit[rows]
        if placed is not None and room is not None:
            jammed |= _finger_room(probe.hand, hand_pose[rows], way, placed.take(rows)) < room[rows] - 1e-6
        if not jammed.any():
            break
        share[rows] *= np.where(jammed, 0.5 if look < JAM_LOOKS - 1 else 0.0, 1.0)
        rows = rows[jammed.any(axis=1)]
    return q + (opened - q) * np.where(finger >= 0, share[:, finger], 1.0)


def _finger_depth(probe: Probe, hand_pose: Floats, paths: Floats) -> Floats:
    """(B, fingers) deepest that each finger is in the rest of the hand, or it in the finger, on paths (B, K, D)."""
    count, steps, _ = paths.shape
    finger = _finger_of_body(probe.hand)
    joints = probe.hand.expand(paths).reshape(count * steps, -1)
    depth = probe.body_depths(np.repeat(hand_pose, steps, axis=0), joints).reshape(count, steps, -1).max(axis=1)
    out = np.zeros((count, _fingers(probe.hand)))
    for f in range(out.shape[1]):
        mine = finger == f
        if mine.any():
            out[:, f] = depth[:, mine].max(axis=1)
    return out


def _finger_room(hand: HandModel, hand_pose: Floats, paths: Floats, placed: Placed) -> Floats:
    """(B, fingers) least room of each finger, as `body_room` has it, on paths (B, K, D); inf: no finger."""
    count, steps, _ = paths.shape
    finger = _finger_of_body(hand)
    out = np.full((count, _fingers(hand)), np.inf)
    postures = Posture(np.repeat(hand_pose, steps, axis=0), hand.expand(paths).reshape(count * steps, -1))
    found = body_room(hand, postures, placed.scenes, np.repeat(placed.index, steps))
    found = found.reshape(count, steps, -1).min(axis=1)
    for f in np.unique(finger[finger >= 0]):
        out[:, f] = found[:, finger == f].min(axis=1)
    return out


def _retreat(probe: Probe, hand_pose: Floats, q: Floats) -> Posture:
    count, choices = len(q), len(RETREATS_M)
    back = -quat_rotate(hand_pose[:, 3:], probe.hand.palm.approach)
    poses = np.repeat(hand_pose[:, None], choices, axis=1)
    poses[..., :3] += np.array(RETREATS_M)[None, :, None] * back[:, None]
    joints = probe.hand.expand(q)
    joined = np.repeat(joints, choices, axis=0)
    distance = probe.body_gaps(poses.reshape(-1, 7), joined, reach=PALM_CLEARANCE_M)
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
