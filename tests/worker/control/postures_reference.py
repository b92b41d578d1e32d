"""Postures around a grasp in NumPy, one step after the other: what the kernels are held against."""

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from graspd.service.model.transforms import Floats, quat_rotate
from graspd.worker.control import opening
from graspd.worker.control.opening import CLEARANCE_M, JAM_LOOKS, OPENING_STEP, OPENING_STEPS, STUCK_M
from graspd.worker.control.postures import FRICTION, MAX_PRESSING, PRESSING_M
from graspd.worker.control.squeeze import SPREAD, SUM, TORQUE
from graspd.worker.grasps import Posture
from graspd.worker.hands.jaws import slides
from graspd.worker.hands.kinematics import body_poses, generalized_forces
from graspd.worker.hands.model import HandModel
from graspd.worker.quality.contact import finger_of_body
from graspd.worker.quality.probe import NearestPoints, Probe
from graspd.worker.quality.wrench_space import wrenches
from tests.worker.quality.helpers import choose_contacts


def pregrasp(probe: Probe, grasp: Posture) -> Posture:
    """N postures from which the hand closes, as `worker.control.postures` wants them."""
    hand = probe.hand
    q = hand.reduce(grasp.joint_positions)
    finger = opening.fingers_of_dofs(hand)
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
    return _retreat(probe, grasp.hand_pose, _without_jams(probe, grasp.hand_pose, q, opened))


def _leaving(probe: Probe, found: NearestPoints, finger: NDArray[np.int32]) -> Floats:
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
                out[b, mine] = opening.PLAIN_OPENING * out[b, mine] + (1 - opening.PLAIN_OPENING) * away[mine] / fastest
    return out


def _openings(hand: HandModel, q: Floats, direction: Floats) -> Floats:
    """(B, K, D) dof values on the way along `direction` (B, D), the grasp first, all within the limits."""
    step = OPENING_STEP * np.arange(OPENING_STEPS + 1)
    direction = direction * np.where(slides(hand), opening.SLIDING_STEP_M / OPENING_STEP, 1.0)
    path = q[:, None] + step[None, :, None] * direction[:, None]
    # A grasp may stand a hair outside its limits: opening must not make a jump of that.
    return np.clip(path, np.minimum(hand.lower, q)[:, None], np.maximum(hand.upper, q)[:, None])


def _finger_clearance(probe: Probe, hand_pose: Floats, paths: Floats) -> Floats:
    """(B, K, fingers) least distance of each finger's points to the object, at most `CLEARANCE_M`."""
    count, steps, _ = paths.shape
    finger = opening.fingers_of_bodies(probe.hand)[probe.points.body]
    joints = probe.hand.expand(paths).reshape(count * steps, -1)
    distance = _distances(probe, np.repeat(hand_pose, steps, axis=0), joints, reach=CLEARANCE_M)
    out = np.full((count * steps, opening.count_fingers(probe.hand)), CLEARANCE_M)
    for f in np.unique(finger[finger >= 0]):
        out[:, f] = distance[:, finger == f].min(axis=1)
    return out.reshape(count, steps, -1)


def _distances(probe: Probe, hand_pose: Floats, joints: Floats, *, reach: float) -> Floats:
    """(B, P) signed distances of the hand's points at B postures, at most `reach` [m]."""
    posed = probe.posed_points(body_poses(probe.hand, hand_pose, joints))
    return probe.signed_distance(posed.reshape(-1, 3), reach=reach)[0].reshape(posed.shape[:2])


def _first_clear(clearance: Floats, wanted: float) -> NDArray[np.intp]:
    """Index along axis 1 of the first clearance that is enough, or of the greatest."""
    # The kernels have `wanted` in single precision.
    enough = clearance >= wanted - 1e-9
    return np.where(enough.any(axis=1), enough.argmax(axis=1), clearance.argmax(axis=1))


def _without_jams(probe: Probe, hand_pose: Floats, q: Floats, opened: Floats) -> Floats:
    """(B, D) the postures `opened`, fingers held back towards the grasp q where they would run into one another."""
    finger = opening.fingers_of_dofs(probe.hand)
    limit = _finger_depth(probe, hand_pose, q[:, None]) + opening.JAM_M
    share = np.ones_like(limit)
    for look in range(JAM_LOOKS):
        move = (opened - q) * np.where(finger >= 0, share[:, finger], 1.0)
        path = q[:, None] + np.array(opening.WAY)[None, :, None] * move[:, None]
        jammed = _finger_depth(probe, hand_pose, path) > limit
        share *= np.where(jammed, 0.5 if look < JAM_LOOKS - 1 else 0.0, 1.0)
    return q + (opened - q) * np.where(finger >= 0, share[:, finger], 1.0)


def _finger_depth(probe: Probe, hand_pose: Floats, paths: Floats) -> Floats:
    """(B, fingers) deepest that each finger is in the rest of the hand, or it in the finger, on paths (B, K, D)."""
    count, steps, _ = paths.shape
    finger = opening.fingers_of_bodies(probe.hand)
    joints = probe.hand.expand(paths).reshape(count * steps, -1)
    bodies = body_poses(probe.hand, np.repeat(hand_pose, steps, axis=0), joints)
    depth = probe.self_depth(bodies, probe.posed_points(bodies)).reshape(count, steps, -1).max(axis=1)
    out = np.zeros((count, opening.count_fingers(probe.hand)))
    for f in np.unique(finger[finger >= 0]):
        out[:, f] = depth[:, finger == f].max(axis=1)
    return out


def _retreat(probe: Probe, hand_pose: Floats, q: Floats) -> Posture:
    count, choices = len(q), len(opening.RETREATS_M)
    back = -quat_rotate(hand_pose[:, 3:], probe.hand.palm.approach)
    poses = np.repeat(hand_pose[:, None], choices, axis=1)
    poses[..., :3] += np.array(opening.RETREATS_M)[None, :, None] * back[:, None]
    joints = probe.hand.expand(q)
    joined = np.repeat(joints, choices, axis=0)
    distance = _distances(probe, poses.reshape(-1, 7), joined, reach=opening.PALM_CLEARANCE_M)
    chosen = _first_clear(distance.min(axis=1).reshape(count, choices), opening.PALM_CLEARANCE_M)
    return Posture(poses[np.arange(count), chosen], joints)


def balanced(probe: Probe, grasp: Posture, total: float, *, closing: float) -> list[tuple[float, Floats]]:
    """Residual and torques (D,) of the forces that balance in each grasp; least squares by SciPy."""
    found = probe.touch(grasp, reach=max(PRESSING_M, closing))
    pressing = probe.facing(found) & (found.distance < PRESSING_M)
    finger = finger_of_body(probe.hand)[probe.points.body]
    for f in range(finger.max() + 1):
        idle = ~pressing[:, finger == f].any(axis=1)
        pressing |= probe.facing(found) & (found.distance < closing) & idle[:, None] & (finger == f)
    out = []
    for b in range(len(grasp)):
        place, normal = found.closest[b], found.normal[b]
        chosen = choose_contacts(pressing[b], place, normal, scale=probe.obj.radius, limit=MAX_PRESSING)
        contacts = (found.bodies[b], probe.points.body[chosen], place[chosen], -normal[chosen])
        out.append(_balanced(probe, *contacts, total) if len(chosen) else (1.0, np.zeros(probe.hand.dofs)))
    return out


def _balanced(
    probe: Probe, bodies: Floats, body: NDArray[np.int32], place: Floats, normal: Floats, total: float
) -> tuple[float, Floats]:
    hand, obj = probe.hand, probe.obj
    edge = wrenches(place, normal, friction=FRICTION, centre=obj.centre_of_mass, radius=obj.radius)
    torque = generalized_forces(hand, bodies, body, place, edge[..., :3]).reshape(-1, hand.dofs)
    edge = edge.reshape(-1, 6)
    effort = torque / hand.effort
    effort /= max(1e-12, np.abs(effort).max())
    system = np.concatenate([edge, np.full((len(edge), 1), SUM), TORQUE * effort, SPREAD * np.eye(len(edge))], axis=1)
    target = np.zeros(system.shape[1])
    target[6] = SUM
    share = nnls(system.T, target)[0]
    share /= share.sum()
    wanted = total * share @ torque
    return float(np.linalg.norm(share @ edge)), wanted / max(1.0, float((np.abs(wanted) / hand.effort).max()))
