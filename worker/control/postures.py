"""Postures around a grasp: the open pregrasp without contact, and the squeeze that presses.

Both affect a grasp's success more than the optimiser does (Dexonomy, table VI).

A finger at rest on the table would sweep through the table on opening. Pregrasps of such hands are raised slightly."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.matter import ACCELERATION
from graspd.service.model.transforms import Floats, Mask
from graspd.worker.control.jaw_squeeze import jaw_squeeze
from graspd.worker.control.opening import (
    Blocked,
    Openings,
    count_fingers,
    dof_steps,
    fingers_of_bodies,
    fingers_of_dofs,
)
from graspd.worker.control.squeeze import HoldForces, balance_forces
from graspd.worker.grasps import Posture
from graspd.worker.hands.jaws import jaws_of
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.quality.posed import PostureData, posture_data_of
from graspd.worker.simulation.environment import CLEAR_M, PlacedGrasps
from graspd.worker.simulation.obstacles import body_clearance, obstacle_clearance

#: Clearance of opening fingers from obstacles [m].
ROOM_M: Final = 0.0025
#: Largest opening of a joint beyond the pregrasp, on the approach, as a share of its range. Without this opening,
#: fingers that enclose the object would push it away on the approach.
WIDE: Final = 0.4

#: Number of hand points in the check of a posture; largest distance [m] and largest number of points that press.
_POINTS: Final = 600
PRESSING_M: Final = 0.003
MAX_PRESSING: Final = 16
#: The squeeze also closes a finger without contact at less than this distance [m]. Otherwise the other fingers push a
#: free object past it.
CLOSING_M: Final = 0.009
#: Least and largest distance at which a finger stands off the object [m]. Farther fingers are not part of the grasp.
STANDS_OFF_M: Final = (0.005, 0.02)
#: Distances of such fingers are measured up to this far beyond the largest one [m].
BEYOND_M: Final = 0.005
#: Largest number of closing steps of such fingers (`opening.dof_steps`), and their distance at the end [m]. Between two
#: sampled points, a finger's surface is up to half a millimetre closer.
CLOSING_STEPS: Final = 16
CLOSED_M: Final = 0.0005
#: Sum of the contact forces' normal components [N], and the Coulomb coefficient for their balance. The coefficient is
#: smaller than the object's: forces at the edge of their friction cones slip after a small displacement.
TOTAL_NORMAL_FORCE: Final = 50.0
FRICTION: Final = 0.3
#: Least and largest ratio of this sum to the object's weight. With a sum of 50 N, fingertips at the upper edges of a
#: light flat object push it out. The largest ratio gives 50 N at 0.1 kg.
OF_WEIGHT: Final = (10.0, 50.0)
#: Least sum [N]. With less, the squeeze moves fingers by less than the gaps at their contacts, and objects of 1 g slip.
LEAST_NORMAL_FORCE: Final = 2.0


def pregrasp(
    hand: HandModel, obj: ObjectModel, grasp: Posture, placed: PlacedGrasps | None = None, *, device: str = "cpu"
) -> Posture:
    """Compute N postures from which the hand closes.
    Every finger moves away from the object along its contact normals until its points are `CLEARANCE_M` away. It stops
    earlier at other fingers and, for `placed` grasps, at obstacles of the scene. Then the root retreats along the
    palm's approach until contact ends. The root rises where fingers would penetrate a support they may touch."""
    posing = posture_data_of(hand, obj, points=_POINTS, device=device)
    poses, joints = np.zeros((len(grasp), 7)), np.zeros((len(grasp), len(hand.joint_names)))
    for rows in posing.row_slices(len(grasp)):
        some, scene = grasp.take(rows), placed.take(rows) if placed is not None else None
        opening = Openings(posing, some.hand_pose, hand.reduce(some.joint_positions))
        opening.open_from(some)
        joints[rows] = hand.expand(opening.without_jams(_blocked_paths(hand, opening, scene)))
        poses[rows] = opening.retreated()
    found = Posture(poses, joints)
    return found if placed is None else raise_pregrasps(hand, grasp, found, placed)


def wide_open_joints(hand: HandModel, obj: ObjectModel, pregrasp: Posture, placed: PlacedGrasps) -> Floats:
    """Return joint positions (N, J) for the approach, with fingers opened by `WIDE` of their range.
    Fingers open against `HandModel.closing`, and stop before they touch one another or an obstacle."""
    posing = posture_data_of(hand, obj, points=_POINTS, device="cpu")
    joints = np.zeros((len(pregrasp), len(hand.joint_names)))
    for rows in posing.row_slices(len(pregrasp)):
        some, scene = pregrasp.take(rows), placed.take(rows)
        q = hand.reduce(some.joint_positions)
        far = np.where(hand.closing > 0, hand.lower, np.where(hand.closing < 0, hand.upper, q))
        wide = np.where(fingers_of_dofs(hand) >= 0, q + np.clip(far - q, -WIDE * hand.span, WIDE * hand.span), q)
        opening = Openings(posing, some.hand_pose, q, wide)
        joints[rows] = hand.expand(opening.without_jams(_blocked_paths(hand, opening, scene)))
    return joints


def squeeze(
    hand: HandModel, obj: ObjectModel, grasp: Posture, *, total_normal_force: float | None = None, device: str = "cpu"
) -> Posture:
    """Compute N commanded postures q + Kp^-1 J^T f that press (`worker.control.squeeze`); root unchanged."""
    force = normal_force(obj) if total_normal_force is None else total_normal_force
    if (jaws := jaws_of(hand)) is not None:
        probe = posture_data_of(hand, obj, points=_POINTS, device=device).probe
        return jaw_squeeze(probe, jaws, grasp, total_normal_force=force)
    holds = hold_forces(hand, obj, grasp, total_normal_force=force, closing=CLOSING_M, device=device)
    q = hand.reduce(grasp.joint_positions) + holds.torque / hand.stiffness
    return Posture(np.array(grasp.hand_pose, float), hand.expand(q))


def hold_forces(
    hand: HandModel,
    obj: ObjectModel,
    grasp: Posture,
    *,
    total_normal_force: float | None = None,
    friction: float = FRICTION,
    closing: float = 0.0,
    device: str = "cpu",
) -> HoldForces:
    """Compute balanced contact forces of N grasps; `HoldForces.residual` predicts whether a grasp holds.
    Fingers without contact press with their points within `closing` [m]."""
    posing = posture_data_of(hand, obj, points=_POINTS, device=device)
    total, reach = normal_force(obj) if total_normal_force is None else total_normal_force, (PRESSING_M, closing)
    found = HoldForces(np.ones(len(grasp)), np.zeros((len(grasp), hand.dofs)))
    for rows in posing.row_slices(len(grasp)):
        residual, torque = balance_forces(posing, grasp.take(rows), total, friction, reach, MAX_PRESSING)
        found.residual[rows], found.torque[rows] = residual, torque
    return found


def normal_force(obj: ObjectModel) -> float:
    least, most = (times * ACCELERATION * obj.mass for times in OF_WEIGHT)
    return max(min(max(TOTAL_NORMAL_FORCE, least), most), LEAST_NORMAL_FORCE)


def touching_links(hand: HandModel, obj: ObjectModel, grasp: Posture, *, device: str = "cpu") -> NDArray[np.int32]:
    """Return the number (N,) of the hand's bodies in contact, by the rule of the geometric gate."""
    return posture_data_of(hand, obj, points=_POINTS, device=device).count_touching_links(grasp)


def fingers_off_object(hand: HandModel, obj: ObjectModel, grasp: Posture, *, device: str = "cpu") -> Mask:
    """Return a mask (N,) of grasps with a finger whose distance from the object is in `STANDS_OFF_M`."""
    return np.asarray(_fingers_off_object(posture_data_of(hand, obj, points=_POINTS, device=device), grasp).any(axis=1))


def close_fingers(
    hand: HandModel,
    obj: ObjectModel,
    grasp: Posture,
    placed: PlacedGrasps | None,
    *,
    off_m: tuple[float, float] = STANDS_OFF_M,
    device: str = "cpu",
) -> Posture:
    """Close fingers of N grasps at a distance in `off_m` until they touch the object.
    A finger that would first meet another finger or an obstacle keeps its posture. Grippers are unchanged."""
    posing = posture_data_of(hand, obj, points=_POINTS, device=device)
    off = _fingers_off_object(posing, grasp, off_m)
    rows = np.flatnonzero(off.any(axis=1))
    if not len(rows) or jaws_of(hand) is not None:
        return grasp
    pose, finger, joints = grasp.hand_pose[rows], fingers_of_dofs(hand), np.array(grasp.joint_positions, float)
    q, moved = hand.reduce(joints[rows]), off[rows][:, finger] & (finger >= 0)
    closing = Openings(posing, pose, q, _close_until_contact(posing, pose, q, moved, off_m[1] + BEYOND_M))
    closed = closing.without_jams(_blocked_paths(hand, closing, None if placed is None else placed.take(rows)))
    reached = posing.finger_gaps(Posture(pose, hand.expand(closed)), off_m[1] + BEYOND_M) < off_m[0]
    joints[rows] = hand.expand(np.where(moved & reached[:, finger], closed, q))
    return Posture(np.array(grasp.hand_pose, float), joints)


def _fingers_off_object(posing: PostureData, grasp: Posture, off_m: tuple[float, float] = STANDS_OFF_M) -> Mask:
    """Return a mask (N, F) of fingers at a distance from the object in `off_m`."""
    near, far = off_m
    gap = posing.finger_gaps(grasp, far + BEYOND_M)
    return np.asarray((gap > near) & (gap < far))


def _close_until_contact(posing: PostureData, hand_pose: Floats, q: Floats, moved: Mask, reach: float) -> Floats:
    """Return dofs (n, D); those `moved` (n, D) are closed until their finger's distance is `CLOSED_M`.
    Distances are measured up to `reach` [m]."""
    hand, count, looks = posing.hand, len(q), CLOSING_STEPS + 1
    step = moved * hand.closing * dof_steps(hand)
    path = np.clip(q[:, None] + np.arange(looks)[None, :, None] * step[:, None], hand.lower, hand.upper)
    postures = Posture(np.repeat(hand_pose, looks, axis=0), hand.expand(path.reshape(count * looks, -1)))
    gaps = posing.finger_gaps(postures, reach).reshape(count, looks, -1)
    last = np.maximum((gaps <= CLOSED_M).argmax(axis=1), 1)[:, None]
    before, after = (np.take_along_axis(gaps, at, axis=1)[:, 0] for at in (last - 1, last))
    share = np.clip((before - CLOSED_M) / np.maximum(before - after, 1e-9), 0.0, 1.0)
    steps = (last[:, 0] - 1 + share)[:, fingers_of_dofs(hand)]
    return np.clip(q + steps * step, hand.lower, hand.upper)


def _blocked_paths(hand: HandModel, opening: Openings, placed: PlacedGrasps | None) -> Blocked | None:
    if placed is None:
        return None
    pose = opening.hand_pose
    # A finger may be closer to an obstacle in the grasp than allowed; opening must not bring it closer.
    room = np.minimum(_finger_clearance(hand, pose, opening.q[:, None], placed), ROOM_M)

    def blocked(rows: NDArray[np.intp], way: Floats) -> Mask:
        near: Mask = _finger_clearance(hand, pose[rows], way, placed.take(rows)) < room[rows] - 1e-6
        return near

    return blocked


def _finger_clearance(hand: HandModel, hand_pose: Floats, paths: Floats, placed: PlacedGrasps) -> Floats:
    """Return fingers' least clearance (B, F) from obstacles on paths (B, K, D); inf without bodies."""
    count, steps, _ = paths.shape
    finger = fingers_of_bodies(hand)
    out = np.full((count, count_fingers(hand)), np.inf)
    postures = Posture(np.repeat(hand_pose, steps, axis=0), hand.expand(paths).reshape(count * steps, -1))
    found = body_clearance(hand, postures, placed.scenes, np.repeat(placed.index, steps))
    found = found.reshape(count, steps, -1).min(axis=1)
    for f in np.unique(finger[finger >= 0]):
        out[:, f] = found[:, finger == f].min(axis=1)
    return out


#: Clearance of the open hand, and of the closing hand [m]. It exceeds the required one, because checks are discrete.
RAISE_OPEN_M: Final = CLEAR_M + 0.0025

RAISE_CLOSING_M: Final = CLEAR_M + 0.0003
#: Checked shares of the trajectory from the pregrasp to the grasp, without the grasp itself.
RAISE_LOOKS: Final = tuple(np.arange(8) / 8)
#: Largest raise of a hand [m]: a hand raised further would press the object down.
HIGHEST_RAISE_M: Final = 0.008


def raise_pregrasps(hand: HandModel, grasp: Posture, pregrasp: Posture, placed: PlacedGrasps) -> Posture:
    """Return pregrasps (N), raised against gravity by the missing clearance on the straight trajectory.
    Pregrasps with enough clearance, or with more missing than `HIGHEST_RAISE_M`, are unchanged."""
    poses = np.array(pregrasp.hand_pose, float)
    near = np.array([any(one.tips_m is not None for one in scene.obstacles) for scene in placed.scenes], bool)
    rows = np.flatnonzero(near[placed.index])
    if not len(rows):
        return pregrasp
    lack = _missing_clearance(hand, grasp.take(rows), pregrasp.take(rows), placed.take(rows))
    # The raise at the pregrasp decreases to zero along the trajectory.
    height = (lack / (1 - np.array(RAISE_LOOKS))).max(axis=1)
    height = np.where(height <= HIGHEST_RAISE_M, height, 0.0)
    up = np.array([scene.up for scene in placed.scenes])[placed.index[rows]]
    poses[rows, :3] += height[:, None] * up
    return Posture(poses, pregrasp.joint_positions)


def _missing_clearance(hand: HandModel, grasp: Posture, pregrasp: Posture, placed: PlacedGrasps) -> Floats:
    """Return the missing clearance (n, looks) of hands at `RAISE_LOOKS` of their trajectory [m]."""
    share = np.array(RAISE_LOOKS)[None, :, None]
    pose = (1 - share) * pregrasp.hand_pose[:, None] + share * grasp.hand_pose[:, None]
    pose[..., 3:] = pregrasp.hand_pose[:, None, 3:]  # a pregrasp has the orientation of its grasp
    joints = (1 - share) * pregrasp.joint_positions[:, None] + share * grasp.joint_positions[:, None]
    postures = Posture(pose.reshape(-1, 7), joints.reshape(-1, joints.shape[-1]))
    room = obstacle_clearance(hand, postures, placed.scenes, np.repeat(placed.index, len(RAISE_LOOKS)))
    wanted = np.where(np.array(RAISE_LOOKS) > 0, RAISE_CLOSING_M, RAISE_OPEN_M)
    return np.maximum(0.0, wanted - room.reshape(len(grasp), -1))
