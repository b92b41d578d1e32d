"""How a hand comes to its pregrasp in a scene: which way, and how far opened, so that it touches neither the object nor
what stands around."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from service.model.transforms import Floats, quat_rotate
from worker.grasps import Posture
from worker.quality.contact import finger_of_body
from worker.quality.probe import Probe
from worker.scenes.clearance import MARGIN_M
from worker.simulation.mounting import wrist_room
from worker.simulation.obstacles import obstacle_room
from worker.simulation.surroundings import STANDOFF_M, Placed

#: On its way the hand's points stay this far from the object [m], if they can at least so far: between points that are
#: looked at, and where the object's convex pieces stand out, it is nearer.
OBJECT_MARGIN_M: Final = 0.001
OBJECT_WANTED_M: Final = 0.004
#: By this much the hand may come nearer to the object than its pregrasp is [m].
NEARER_M: Final = 5e-4
#: Postures stored on the approach, the standoff first, the pregrasp last; so many are looked at between two, and
#: while the hand then closes to the pregrasp.
WAYPOINTS: Final = 6
LOOKS: Final = 4
_CLOSING: Final = 4
#: Directions of retreat that are tried: the palm's own, mixed with these shares of the direction against gravity.
SHARES_UP: Final = (0.0, 0.25, 0.5, 0.75, 1.0)
#: How wide the hand comes: shares of the way from the pregrasp to wide open. Each is tried with all directions.
OPENNESS: Final = (1.0, 0.5, 0.0)


def come_open(
    probe: Probe, pregrasp: Posture, wide: Floats, wrist: Floats, placed: Placed
) -> tuple[Floats, Floats, Floats, NDArray[np.bool_]]:
    """Waypoints (n, W, 7), joints (n, J) of the hand that comes, the least distance of it and its mounting, at wrist
    angles (n, K), from obstacles (n,) and whether it touches the object (n,): wide open if it can, its fingers far from
    the object."""
    count = len(pregrasp)
    up = np.array([scene.up for scene in placed.scenes])[placed.index]
    back = -quat_rotate(pregrasp.hand_pose[:, 3:], probe.hand.palm.approach)
    best, least, touching = np.full(count, -np.inf), np.zeros(count), np.ones(count, bool)
    chosen, joints = np.zeros((count, 3)), np.array(wide)
    open_ = np.arange(count)
    for openness in OPENNESS:
        for share in SHARES_UP:
            way = (1 - share) * back[open_] + share * up[open_]
            length = np.linalg.norm(way, axis=1, keepdims=True)
            way = np.where(length > 1e-6, way / np.maximum(length, 1e-6), up[open_])
            start = pregrasp.joint_positions[open_]
            opened = start + openness * (wide[open_] - start)
            room, gap = _seen(probe, pregrasp.take(open_), opened, wrist[open_], way, placed.take(open_))
            score = np.minimum(room, MARGIN_M) + 0.1 * np.minimum(gap, OBJECT_WANTED_M) - (gap < OBJECT_MARGIN_M)
            better = score > best[open_]
            rows = open_[better]
            best[rows], least[rows], touching[rows] = score[better], room[better], gap[better] < OBJECT_MARGIN_M
            chosen[rows], joints[rows] = way[better], opened[better]
            open_ = open_[best[open_] < MARGIN_M + 0.1 * OBJECT_WANTED_M - 1e-9]
            if not len(open_):
                break
        if not len(open_):
            break
    poses = np.repeat(pregrasp.hand_pose[:, None], WAYPOINTS, axis=1)
    poses[..., :3] += np.linspace(STANDOFF_M, 0.0, WAYPOINTS)[:, None] * chosen[:, None]
    return poses, joints, least, touching


def _seen(
    probe: Probe, pregrasp: Posture, opened: Floats, wrist: Floats, way: Floats, placed: Placed
) -> tuple[Floats, Floats]:
    """Least distance (n,) from obstacles of hands that come open along directions `way` (n, 3) on their mountings, and
    of hands from the object until they have closed to the pregrasp."""
    count, looks = len(pregrasp), (WAYPOINTS - 1) * LOOKS + 1
    poses = np.repeat(pregrasp.hand_pose[:, None], looks + _CLOSING, axis=1)
    poses[:, :looks, :3] += np.linspace(STANDOFF_M, 0.0, looks)[:, None] * way[:, None]
    share = np.concatenate([np.zeros(looks), np.arange(1, _CLOSING + 1) / _CLOSING])
    joints = opened[:, None] + share[:, None] * (pregrasp.joint_positions - opened)[:, None]
    postures = Posture(poses.reshape(-1, 7), joints.reshape(len(share) * count, -1))
    coming = np.tile(share == 0, count)
    scenes, which = placed.scenes, np.asarray(placed.index, np.intp)
    room = obstacle_room(probe.hand, postures.take(np.flatnonzero(coming)), scenes, np.repeat(which, looks))
    free = room.reshape(count, looks).min(axis=1)
    rows = np.flatnonzero(free >= MARGIN_M)
    if (mounting := probe.hand.mounting) is not None and len(rows):
        # A mounting is thicker than a finger: it is looked at half as often, where the hand itself is clear.
        mounted = wrist_room(mounting, poses[rows, :looks:2], wrist[rows], scenes, which[rows])
        free[rows] = np.minimum(free[rows], mounted)
    # What is farther than this counts alike.
    reach = OBJECT_WANTED_M + 2 * NEARER_M
    gap = probe.body_gaps(postures.hand_pose, postures.joint_positions, reach=reach).reshape(count, len(share), -1)
    fingers = finger_of_body(probe.hand) >= 0
    least = np.full(count, np.inf)
    for part in (fingers, ~fingers):
        if part.any():
            near = gap[..., part].min(axis=2)
            # The pregrasp itself may stand nearer than wanted: coming must not be nearer than it is.
            short = near[:, :-1].min(axis=1) - np.minimum(OBJECT_WANTED_M, near[:, -1] - NEARER_M)
            least = np.minimum(least, OBJECT_WANTED_M + short)
    return free, least
