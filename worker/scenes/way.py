"""The hand's way: from a standoff to the pregrasp, closing, the lift; and what it stays clear of.

In a scene the lift goes against gravity. Around a free object it is the way back, as the hand came.
Distances are those of `body_room`: fingertips that may touch a support count as farther from it.
The mounting of the hand, at wrist angles that it keeps all the way, stays clear as the hand does.
Against half-spaces they are exact. Against boxes and neighbours' pieces they are those of the hand's features from
the obstacle's planes: exact where a corner is nearest, else a lower bound of the features' distance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from service.model.transforms import IDENTITY_POSE, Floats, quat_from_axis_angle, quat_rotate
from worker.grasps import GraspSet, Posture, moved
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel
from worker.quality.postures import wide_open
from worker.quality.probe import Probe, probe_of
from worker.scenes.clearance import MARGIN_M, PATH_POSTURES, approach
from worker.scenes.coming import LOOKS, OBJECT_MARGIN_M, WAYPOINTS, come_open
from worker.simulation.mounting import mounting_room
from worker.simulation.obstacles import obstacle_room
from worker.simulation.surroundings import RISE_M, STANDOFF_M, Placed, Surroundings

_POINTS: Final = 600
#: Around a free object: tilts of the retreat from the palm's own direction [rad], each to so many sides.
TILTS: Final = (0.4, 0.8, 1.2)
SIDES: Final = 8
#: Points of hand and object with which a way around a free object is looked at.
_FREE_POINTS: Final = (2000, 3000)


@dataclass(frozen=True)
class Way:
    """How N grasps are reached and lifted, in the object frame."""

    approach: Floats
    """(N, W, 7) hand poses from the standoff to the pregrasp, in the joint positions `open`."""
    open: Floats
    """(N, J) joint positions of the hand that comes."""
    lift: Posture
    """N squeeze postures raised against gravity."""
    contact: Floats
    """(N,) least distance from obstacles at the grasp [m]."""
    closing: Floats
    """(N,) from the pregrasp to the grasp."""
    coming: Floats
    """(N,) on the approach; the hand's points also stay clear of the object where `touching` is False."""
    lifting: Floats
    """(N,) on the lift."""
    touching: NDArray[np.bool_]
    """(N,) whether the open hand touches the object on its way."""
    wrist: Floats
    """(N, K) angles of the wrist above the hand's root; K is 0 where it has none."""
    mounting: Floats
    """(N,) of the hand's mounting at the grasp, while the hand closes and on the lift; on the approach it counts as the
    hand does."""

    @property
    def least(self) -> Floats:
        """(N,) least distance from obstacles anywhere on the way [m]."""
        parts = (self.contact, self.closing, self.coming, self.lifting, self.mounting)
        return np.asarray(np.minimum.reduce(parts))

    @property
    def clear(self) -> NDArray[np.bool_]:
        """(N,) whether the whole way is free."""
        return np.asarray((self.least >= MARGIN_M) & ~self.touching)


def plan_way(hand: HandModel, obj: ObjectModel, grasps: GraspSet, placed: Placed) -> Way:
    """The way of every grasp in its scene: the first direction of retreat that is free, or else the freest."""
    probe = probe_of(hand, obj, hand_points=_POINTS, object_points=64)
    count, scenes, which = len(grasps), placed.scenes, np.asarray(placed.index, np.intp)
    rise = RISE_M * np.array([scene.up for scene in scenes])[which]
    wide = wide_open(hand, obj, grasps.pregrasp, placed)

    def room(postures: Posture, steps: int = PATH_POSTURES) -> Floats:
        return obstacle_room(hand, postures, scenes, np.repeat(which, steps)).reshape(count, steps)

    closing_hand = approach(grasps.grasp, grasps.pregrasp)
    between = room(closing_hand)
    lifted = np.repeat(grasps.grasp.hand_pose[:, None], WAYPOINTS, axis=1)
    lifted[..., :3] += np.linspace(0, 1, WAYPOINTS)[:, None] * rise[:, None]
    taken = np.concatenate([closing_hand.hand_pose.reshape(count, PATH_POSTURES, 7)[:, ::4], lifted], axis=1)
    wrist, mounting = mounting_room(hand, taken, scenes, which)
    path, came, coming, touching = come_open(probe, grasps.pregrasp, wide, wrist, placed)
    before = room(approach(grasps.pregrasp, Posture(grasps.pregrasp.hand_pose, came)))
    joints = np.repeat(grasps.grasp.joint_positions, WAYPOINTS, axis=0)
    lifting = room(Posture(lifted.reshape(-1, 7), joints), WAYPOINTS).min(axis=1)
    contact, closing = between[:, -1], np.minimum(between.min(axis=1), before.min(axis=1))
    raised = np.array(grasps.squeeze.hand_pose, float)
    raised[:, :3] += rise
    lift = Posture(moved(raised, np.zeros(3)), np.array(grasps.squeeze.joint_positions, float))
    return Way(moved(path, np.zeros(3)), came, lift, contact, closing, coming, lifting, touching, wrist, mounting)


def plan_free_way(hand: HandModel, obj: ObjectModel, grasps: GraspSet) -> Way:
    """The way of grasps of an object that stands alone: a retreat of `STANDOFF_M` that is free of the object.

    The palm's own direction of retreat is tried first, then others ever farther from it. `lift` is the squeeze posture
    after that retreat, object in hand. Nothing stands around, so all distances from obstacles are infinite.
    """
    hand_points, object_points = _FREE_POINTS
    probe = probe_of(hand, obj, hand_points=hand_points, object_points=object_points)
    nowhere = Placed((), IDENTITY_POSE[None], np.zeros(len(grasps), np.intp))
    wide = _opened(probe, grasps.pregrasp, wide_open(hand, obj, grasps.pregrasp, nowhere))
    pointing = quat_rotate(wide.hand_pose[:, 3:], hand.palm.approach)
    ways = [-pointing, *(_tilted(-pointing, tilt, side) for tilt in TILTS for side in range(SIDES))]
    path, _, touching, chosen = _coming(probe, wide, nowhere.scenes[0], ways)
    raised = np.array(grasps.squeeze.hand_pose, float)
    raised[:, :3] += STANDOFF_M * chosen
    lift = Posture(raised, np.array(grasps.squeeze.joint_positions, float))
    endless = np.full(len(grasps), np.inf)
    still, _ = mounting_room(hand, path[:, -1:], nowhere.scenes)
    return Way(path, wide.joint_positions, lift, endless, endless, endless, endless, touching, still, endless)


def _opened(probe: Probe, pregrasp: Posture, joints: Floats) -> Posture:
    """Pregrasps with fingers opened to `joints` (n, J), but where that would bring them nearer to the object."""
    start = np.asarray(pregrasp.joint_positions, float)
    room = np.minimum(OBJECT_MARGIN_M, _gaps(probe, pregrasp)) - 5e-4
    nearer = np.zeros(len(start), bool)
    for share in (1 / 3, 2 / 3, 1.0):
        nearer |= _gaps(probe, Posture(pregrasp.hand_pose, start + share * (joints - start))) < room
    return Posture(np.array(pregrasp.hand_pose, float), np.where(nearer[:, None], start, joints))


def _unit(ways: Floats, instead: Floats) -> Floats:
    """(n, 3) directions of length 1; `instead` where there is none."""
    length = np.linalg.norm(ways, axis=1, keepdims=True)
    return np.where(length > 1e-6, ways / np.maximum(length, 1e-6), instead)


def _tilted(axis: Floats, tilt: float, side: int) -> Floats:
    """(n, 3) unit vectors turned by `tilt` [rad] away from axes (n, 3), towards one of `SIDES` sides."""
    least = np.eye(3)[np.argmin(np.abs(axis), axis=1)]
    across = _unit(np.cross(axis, least), least)
    leaning = quat_rotate(quat_from_axis_angle(across, np.full(len(axis), tilt)), axis)
    return quat_rotate(quat_from_axis_angle(axis, np.full(len(axis), 2 * np.pi * side / SIDES)), leaning)


def _coming(
    probe: Probe, pregrasp: Posture, scene: Surroundings, ways: Sequence[Floats]
) -> tuple[Floats, Floats, NDArray[np.bool_], Floats]:
    """Waypoints (n, W, 7), least distance from obstacles (n,), whether the object is touched (n,), and the direction of
    retreat (n, 3): the first of `ways`, (n, 3) each, that is free, or else the freest.
    """
    count, looks = len(pregrasp), (WAYPOINTS - 1) * LOOKS + 1
    best = np.full(count, -np.inf)
    least = np.zeros(count)
    touching = np.ones(count, bool)
    chosen = np.zeros((count, 3))
    open_ = np.arange(count)
    for tried in ways:
        way = tried[open_]
        poses = np.repeat(pregrasp.hand_pose[open_, None], looks, axis=1)
        poses[..., :3] += np.linspace(STANDOFF_M, 0.0, looks)[:, None] * way[:, None]
        joints = np.repeat(pregrasp.joint_positions[open_], looks, axis=0)
        postures = Posture(poses.reshape(-1, 7), joints)
        room = obstacle_room(probe.hand, postures, [scene]).reshape(len(open_), looks).min(axis=1)
        gap = _gaps(probe, postures).reshape(len(open_), looks)
        # The pregrasp itself may stand nearer than the margin: coming must not be nearer than it is.
        hits = gap[:, :-1].min(axis=1) < np.minimum(OBJECT_MARGIN_M, gap[:, -1]) - 5e-4
        score = np.minimum(room, MARGIN_M) - hits
        better = score > best[open_]
        rows = open_[better]
        best[rows], least[rows], touching[rows], chosen[rows] = score[better], room[better], hits[better], way[better]
        open_ = open_[best[open_] < MARGIN_M]
        if not len(open_):
            break
    poses = np.repeat(pregrasp.hand_pose[:, None], WAYPOINTS, axis=1)
    poses[..., :3] += np.linspace(STANDOFF_M, 0.0, WAYPOINTS)[:, None] * chosen[:, None]
    return poses, least, touching, chosen


def _gaps(probe: Probe, postures: Posture) -> Floats:
    """(P,) least distance of the hand's points from the object, and of the object's from the hand [m]."""
    found = probe.measure(postures)
    return np.minimum(found.distance.min(axis=1), found.piece_distance.min(axis=1))
