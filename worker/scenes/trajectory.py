"""Trajectories of the hand: from a standoff to the pregrasp, closing and lift, with their clearances.

In a scene the lift is a motion against gravity; around a free object it is the retreat along the approach. The hand's
mounting must be clear as well, at wrist angles that are constant over the trajectory. Clearances are those of
`body_clearance`, with more tolerance for fingertips that may touch a support. Clearances from half-spaces are exact;
some from boxes and neighbours' pieces are lower bounds.

In a scene, the direction of the approach and the opening of the hand are chosen to avoid object and obstacles."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.transforms import IDENTITY_POSE, Floats, quat_from_axis_angle, quat_rotate
from graspd.worker.control.postures import wide_open_joints
from graspd.worker.grasps import GraspSet, Posture, move_poses
from graspd.worker.hands.digits import finger_of_body
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.quality.probe import Probe, probe_of
from graspd.worker.scenes.clearance import MARGIN_M, PATH_POSTURES, approach_postures
from graspd.worker.simulation.environment import RISE_M, STANDOFF_M, Environment, PlacedGrasps
from graspd.worker.simulation.mounting import choose_wrist, wrist_clearance
from graspd.worker.simulation.obstacles import obstacle_clearance

_POINTS: Final = 600
#: Around a free object: tilts of the retreat from the palm's own direction [rad], and number of directions per tilt.
TILTS: Final = (0.4, 0.8, 1.2)
SIDES: Final = 8
#: Points of hand and object in the check of a trajectory around a free object.
_FREE_POINTS: Final = (2000, 3000)


@dataclass(frozen=True)
class Trajectory:
    """Trajectories of N grasps to contact and lift, in the object frame."""

    approach: Floats  # (N, W, 7) hand poses from the standoff to the pregrasp, with the joint positions `open`
    open: Floats  # (N, J) joint positions of the open hand on its approach
    lift: Posture  # N squeeze postures moved up against gravity
    contact: Floats  # (N,) least clearance from obstacles at the grasp [m]
    closing: Floats  # (N,) least clearance from the pregrasp to the grasp [m]
    coming: Floats  # (N,) least clearance from obstacles on the approach [m]; `touching` is the contact with the object
    lifting: Floats  # (N,) least clearance on the lift [m]
    touching: NDArray[np.bool_]  # (N,) whether the open hand touches the object on its approach
    wrist: Floats  # (N, K) angles of the wrist above the hand's root; K is 0 without a wrist
    mounting: Floats
    """(N,) least clearance of the hand's mounting, except on the approach, where it counts as part of the hand [m]."""

    @property
    def least_clearance(self) -> Floats:
        """(N,) least clearance from obstacles on the whole trajectory [m]."""
        return np.asarray(np.minimum.reduce([self.contact, self.closing, self.coming, self.lifting, self.mounting]))

    @property
    def clear(self) -> NDArray[np.bool_]:
        """(N,) whether the whole trajectory is clear."""
        return np.asarray((self.least_clearance >= MARGIN_M) & ~self.touching)


def plan_trajectory(hand: HandModel, obj: ObjectModel, grasps: GraspSet, placed: PlacedGrasps) -> Trajectory:
    """Plan each grasp's trajectory in its scene.
    The approach has the first free direction of retreat or, without one, that with most clearance."""
    probe = probe_of(hand, obj, hand_points=_POINTS, object_points=64)
    count, scenes, which = len(grasps), placed.scenes, np.asarray(placed.index, np.intp)
    rise = RISE_M * np.array([scene.up for scene in scenes])[which]
    wide = wide_open_joints(hand, obj, grasps.pregrasp, placed)

    def room(postures: Posture, steps: int = PATH_POSTURES) -> Floats:
        return obstacle_clearance(hand, postures, scenes, np.repeat(which, steps)).reshape(count, steps)

    closing_hand = approach_postures(grasps.grasp, grasps.pregrasp)
    between = room(closing_hand)
    lifted = np.repeat(grasps.grasp.hand_pose[:, None], WAYPOINTS, axis=1)
    lifted[..., :3] += np.linspace(0, 1, WAYPOINTS)[:, None] * rise[:, None]
    taken = np.concatenate([closing_hand.hand_pose.reshape(count, PATH_POSTURES, 7)[:, ::4], lifted], axis=1)
    wrist, mounting = choose_wrist(hand, taken, scenes, which)
    path, came, coming, touching = plan_open_approach(probe, grasps.pregrasp, wide, wrist, placed)
    before = room(approach_postures(grasps.pregrasp, Posture(grasps.pregrasp.hand_pose, came)))
    joints = np.repeat(grasps.grasp.joint_positions, WAYPOINTS, axis=0)
    lifting = room(Posture(lifted.reshape(-1, 7), joints), WAYPOINTS).min(axis=1)
    contact, closing = between[:, -1], np.minimum(between.min(axis=1), before.min(axis=1))
    raised = np.array(grasps.squeeze.hand_pose, float)
    raised[:, :3] += rise
    lift = Posture(move_poses(raised, np.zeros(3)), np.array(grasps.squeeze.joint_positions, float))
    return Trajectory(
        move_poses(path, np.zeros(3)), came, lift, contact, closing, coming, lifting, touching, wrist, mounting
    )


def plan_free_trajectory(hand: HandModel, obj: ObjectModel, grasps: GraspSet) -> Trajectory:
    """Plan trajectories around a free object: a retreat of `STANDOFF_M` without contact with the object.
    The palm's own direction of retreat is tested first, then directions with increasing tilt. `lift` is the squeeze
    posture after this retreat, with the object in hand. Without obstacles all clearances are infinite."""
    hand_points, object_points = _FREE_POINTS
    probe = probe_of(hand, obj, hand_points=hand_points, object_points=object_points)
    nowhere = PlacedGrasps((), IDENTITY_POSE[None], np.zeros(len(grasps), np.intp))
    joints = wide_open_joints(hand, obj, grasps.pregrasp, nowhere)
    start = np.asarray(grasps.pregrasp.joint_positions, float)
    room = np.minimum(OBJECT_MARGIN_M, _object_distances(probe, grasps.pregrasp)) - 5e-4
    nearer = np.zeros(len(start), bool)
    for share in (1 / 3, 2 / 3, 1.0):
        nearer |= _object_distances(probe, Posture(grasps.pregrasp.hand_pose, start + share * (joints - start))) < room
    wide = Posture(np.array(grasps.pregrasp.hand_pose, float), np.where(nearer[:, None], start, joints))
    pointing = quat_rotate(wide.hand_pose[:, 3:], hand.palm.approach)
    ways = [-pointing, *(_tilt_axes(-pointing, tilt, side) for tilt in TILTS for side in range(SIDES))]
    path, _, touching, chosen = _plan_approach(probe, wide, nowhere.scenes[0], ways)
    raised = np.array(grasps.squeeze.hand_pose, float)
    raised[:, :3] += STANDOFF_M * chosen
    lift = Posture(raised, np.array(grasps.squeeze.joint_positions, float))
    endless = np.full(len(grasps), np.inf)
    still, _ = choose_wrist(hand, path[:, -1:], nowhere.scenes)
    return Trajectory(path, wide.joint_positions, lift, endless, endless, endless, endless, touching, still, endless)


def _unit(ways: Floats, instead: Floats) -> Floats:
    """Normalise vectors (n, 3); zero vectors become `instead`."""
    length = np.linalg.norm(ways, axis=1, keepdims=True)
    return np.where(length > 1e-6, ways / np.maximum(length, 1e-6), instead)


def _tilt_axes(axis: Floats, tilt: float, side: int) -> Floats:
    """Return unit vectors (n, 3) tilted by `tilt` [rad] from axes (n, 3), towards side number `side`."""
    least = np.eye(3)[np.argmin(np.abs(axis), axis=1)]
    across = _unit(np.cross(axis, least), least)
    leaning = quat_rotate(quat_from_axis_angle(across, np.full(len(axis), tilt)), axis)
    return quat_rotate(quat_from_axis_angle(axis, np.full(len(axis), 2 * np.pi * side / SIDES)), leaning)


def _retreat_poses(hand_pose: Floats, way: Floats, steps: int) -> Floats:
    """Return poses (n, steps, 7) from `STANDOFF_M` along directions `way` (n, 3) to the hands' poses."""
    poses = np.repeat(hand_pose[:, None], steps, axis=1)
    poses[..., :3] += np.linspace(STANDOFF_M, 0.0, steps)[:, None] * way[:, None]
    return poses


def _plan_approach(
    probe: Probe, pregrasp: Posture, scene: Environment, ways: Sequence[Floats]
) -> tuple[Floats, Floats, NDArray[np.bool_], Floats]:
    """Return approaches along the first free direction of `ways` (n, 3), else along the clearest one.
    The result: waypoints (n, W, 7), least clearance (n,), mask (n,) of contact with the object, direction (n, 3)."""
    count, looks = len(pregrasp), (WAYPOINTS - 1) * LOOKS + 1
    best, least, touching = np.full(count, -np.inf), np.zeros(count), np.ones(count, bool)
    chosen, open_ = np.zeros((count, 3)), np.arange(count)
    for tried in ways:
        way = tried[open_]
        poses = _retreat_poses(pregrasp.hand_pose[open_], way, looks)
        joints = np.repeat(pregrasp.joint_positions[open_], looks, axis=0)
        postures = Posture(poses.reshape(-1, 7), joints)
        room = obstacle_clearance(probe.hand, postures, [scene]).reshape(len(open_), looks).min(axis=1)
        gap = _object_distances(probe, postures).reshape(len(open_), looks)
        # The pregrasp itself may be closer than the margin; the approach may then be as close, but not closer.
        hits = gap[:, :-1].min(axis=1) < np.minimum(OBJECT_MARGIN_M, gap[:, -1]) - 5e-4
        score = np.minimum(room, MARGIN_M) - hits
        better = score > best[open_]
        rows = open_[better]
        best[rows], least[rows], touching[rows], chosen[rows] = score[better], room[better], hits[better], way[better]
        open_ = open_[best[open_] < MARGIN_M]
        if not len(open_):
            break
    return _retreat_poses(pregrasp.hand_pose, chosen, WAYPOINTS), least, touching, chosen


def _object_distances(probe: Probe, postures: Posture) -> Floats:
    """Return least distances (P,) of hand points from the object and of object points from the hand [m]."""
    found = probe.measure(postures)
    return np.minimum(found.distance.min(axis=1), found.piece_distance.min(axis=1))


#: Least and preferred distance of hand points from the object on the approach [m]. The true distance is smaller
#: between checked points, and where the object's convex pieces protrude.
OBJECT_MARGIN_M: Final = 0.001
OBJECT_WANTED_M: Final = 0.004
#: On its approach the hand may be closer to the object than at its pregrasp, by at most this [m].
NEARER_M: Final = 5e-4
#: Numbers of stored postures from standoff to pregrasp, of checks between two of them, and of checks while closing.
WAYPOINTS: Final = 6
LOOKS: Final = 4
_CLOSING: Final = 4
#: Directions of retreat to test: the palm's own, mixed with these shares of the direction against gravity.
SHARES_UP: Final = (0.0, 0.25, 0.5, 0.75, 1.0)
#: Openings of the hand, as shares of the range from the pregrasp to wide open. Each is tested with all directions.
OPENNESS: Final = (1.0, 0.5, 0.0)


def plan_open_approach(
    probe: Probe, pregrasp: Posture, wide: Floats, wrist: Floats, placed: PlacedGrasps
) -> tuple[Floats, Floats, Floats, NDArray[np.bool_]]:
    """Return approaches with the hand as wide open as possible, its fingers away from the object.
    The result has waypoints (n, W, 7), joints (n, J), least clearance (n,) from obstacles, and a mask (n,) of hands
    that touch the object. Clearance includes the mounting at wrist angles (n, K)."""
    count = len(pregrasp)
    up = np.array([scene.up for scene in placed.scenes])[placed.index]
    back = -quat_rotate(pregrasp.hand_pose[:, 3:], probe.hand.palm.approach)
    best, least, touching = np.full(count, -np.inf), np.zeros(count), np.ones(count, bool)
    chosen, joints = np.zeros((count, 3)), np.array(wide)
    open_ = np.arange(count)
    for openness, share in product(OPENNESS, SHARES_UP):
        way = _unit((1 - share) * back[open_] + share * up[open_], up[open_])
        start = pregrasp.joint_positions[open_]
        opened = start + openness * (wide[open_] - start)
        room, gap = _retreat_clearance(probe, pregrasp.take(open_), opened, wrist[open_], way, placed.take(open_))
        score = np.minimum(room, MARGIN_M) + 0.1 * np.minimum(gap, OBJECT_WANTED_M) - (gap < OBJECT_MARGIN_M)
        better = score > best[open_]
        rows = open_[better]
        best[rows], least[rows], touching[rows] = score[better], room[better], gap[better] < OBJECT_MARGIN_M
        chosen[rows], joints[rows] = way[better], opened[better]
        open_ = open_[best[open_] < MARGIN_M + 0.1 * OBJECT_WANTED_M - 1e-9]
        if not len(open_):
            break
    return _retreat_poses(pregrasp.hand_pose, chosen, WAYPOINTS), joints, least, touching


def _retreat_clearance(
    probe: Probe, pregrasp: Posture, opened: Floats, wrist: Floats, way: Floats, placed: PlacedGrasps
) -> tuple[Floats, Floats]:
    """Return least clearances (n,) of open hands and mountings that retreat along `way` (n, 3).
    Also return the least distances (n,) of hands from the object until they have closed to the pregrasp."""
    count, looks = len(pregrasp), (WAYPOINTS - 1) * LOOKS + 1
    poses = np.repeat(pregrasp.hand_pose[:, None], looks + _CLOSING, axis=1)
    poses[:, :looks, :3] += np.linspace(STANDOFF_M, 0.0, looks)[:, None] * way[:, None]
    share = np.concatenate([np.zeros(looks), np.arange(1, _CLOSING + 1) / _CLOSING])
    joints = opened[:, None] + share[:, None] * (pregrasp.joint_positions - opened)[:, None]
    postures = Posture(poses.reshape(-1, 7), joints.reshape(len(share) * count, -1))
    coming = np.tile(share == 0, count)
    scenes, which = placed.scenes, np.asarray(placed.index, np.intp)
    room = obstacle_clearance(probe.hand, postures.take(np.flatnonzero(coming)), scenes, np.repeat(which, looks))
    free = room.reshape(count, looks).min(axis=1)
    rows = np.flatnonzero(free >= MARGIN_M)
    if (mounting := probe.hand.mounting) is not None and len(rows):
        # A mounting is thicker than a finger, so half as many checks suffice.
        mounted = wrist_clearance(mounting, poses[rows, :looks:2], wrist[rows], scenes, which[rows])
        free[rows] = np.minimum(free[rows], mounted)
    reach = OBJECT_WANTED_M + 2 * NEARER_M  # larger distances count as this one
    gap = probe.body_gaps(postures.hand_pose, postures.joint_positions, reach=reach).reshape(count, len(share), -1)
    fingers = finger_of_body(probe.hand) >= 0
    least = np.full(count, np.inf)
    for part in (fingers, ~fingers):
        if part.any():
            near = gap[..., part].min(axis=2)
            # The pregrasp itself may be closer than preferred; the approach may then be as close, but not closer.
            short = near[:, :-1].min(axis=1) - np.minimum(OBJECT_WANTED_M, near[:, -1] - NEARER_M)
            least = np.minimum(least, OBJECT_WANTED_M + short)
    return free, least
