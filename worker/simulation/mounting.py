"""Distance of a hand's mounting from obstacles: of the wrist angles that it may take, those nearest to rest count that
keep it clear. Planners ask for the distance of its points, which costs little; what is valid is asked for exactly."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from cachetools import LRUCache
from numpy.typing import NDArray

from graspd.service.model.transforms import IDENTITY_POSE, Floats, apply, quat_conjugate, quat_rotate, spread_directions
from graspd.worker.grasps import Posture
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.mounting import wrist_positions
from graspd.worker.hands.surface import farthest_points
from graspd.worker.simulation.environment import CLEAR_M, Environment
from graspd.worker.simulation.obstacles import MARGIN_M, obstacle_room

#: Points of a mounting: the outermost in so many directions, then so many corners spread over it.
OUTERMOST: Final = 20
SPREAD: Final = 40
#: Wrist positions of a hand whose exact distances are asked for.
TRIES: Final = 4


def mounting_room(
    hand: HandModel,
    poses: Floats,
    scenes: Sequence[Environment],
    which: NDArray[np.integer[Any]] | None = None,
    *,
    enough: float = CLEAR_M,
) -> tuple[Floats, Floats]:
    """The angles of a wrist that keeps them while the hand moves, and the room of the mounting.

    Args:
        hand: the hand.
        poses: (N, P, 7) poses that the root of each of N hands takes, object frame.
        scenes: what stands around.
        which: (N,) scene of each hand; by default the first.
        enough: distance from obstacles with which the search of angles ends [m].

    Returns:
        (N, K) wrist angles: the first of `wrist_positions` with room enough, of those whose points have it, or else the
        one whose points have the most; and (N,) the least distance of the mounting from obstacles at all poses [m].
        Without a mounting K is 0 and the distance inf.
    """
    mounting, count = hand.mounting, len(poses)
    if mounting is None:
        return np.zeros((count, 0)), np.full(count, np.inf)
    scene_of = np.zeros(count, np.intp) if which is None else which.astype(np.intp)
    return _solved(mounting, poses, scenes, scene_of, point_room(mounting, poses, scenes, scene_of), enough)


def mounting_lack(
    hand: HandModel,
    poses: Floats,
    scenes: Sequence[Environment],
    which: NDArray[np.integer[Any]],
    *,
    room: float = 0.0,
    exact: bool = True,
) -> Floats:
    """(N,) what mountings lack of the distance that planners keep from obstacles, and of `room` besides, at root poses
    (N, 7) and the best wrist angles [m]; 0 or more. What their points lack; `exact`: or what they lack themselves."""
    mounting, wanted = hand.mounting, MARGIN_M + room
    if mounting is None or not len(poses):
        return np.zeros(len(poses))
    poses, scene_of = poses[:, None], which.astype(np.intp)
    points = point_room(mounting, poses, scenes, scene_of)
    most = points.max(axis=1)
    rows = np.flatnonzero(exact & (most >= wanted))
    if len(rows):
        _, most[rows] = _solved(mounting, poses[rows], scenes, scene_of[rows], points[rows], wanted)
    return np.asarray(np.maximum(0.0, wanted - most))


def _solved(
    mounting: HandModel,
    poses: Floats,
    scenes: Sequence[Environment],
    which: NDArray[np.intp],
    points: Floats,
    enough: float,
) -> tuple[Floats, Floats]:
    """Angles and room as `mounting_room` has them, from the room of points (N, W), which is used up."""
    wrists, count = wrist_positions(mounting), len(poses)
    number, room, rows = np.zeros(count, np.intp), np.full(count, -np.inf), np.arange(count)
    for _ in range(min(TRIES, len(wrists))):
        hopeful = points[rows] >= enough
        tried = np.where(hopeful.any(axis=1), hopeful.argmax(axis=1), points[rows].argmax(axis=1))
        found = wrist_room(mounting, poses[rows], wrists[tried], scenes, which[rows])
        better = found > room[rows]
        number[rows[better]], room[rows[better]] = tried[better], found[better]
        points[rows, tried] = -np.inf
        rows = rows[(room[rows] < enough) & (points[rows] >= enough).any(axis=1)]
        if not len(rows):
            break
    return wrists[number], room


def point_room(mounting: HandModel, poses: Floats, scenes: Sequence[Environment], which: NDArray[np.intp]) -> Floats:
    """(N, W) least distance of a mounting's points from obstacles of scenes `which` (N,) over root poses (N, P, 7), at
    each wrist position [m]: no less than the mounting's own, but near edges and corners of solids."""
    points = points_of(mounting)
    out = np.full((len(poses), len(points)), np.inf)
    for scene in np.unique(which):
        rows = np.flatnonzero(which == scene)
        place, flat = poses[rows][:, :, None], points.reshape(-1, 3).T
        for obstacle in scenes[scene].obstacles:
            # Planes as the root sees them: points are many, planes few.
            normals = quat_rotate(quat_conjugate(place[..., 3:]), obstacle.planes[:, :3])
            shift = place[..., :3] @ obstacle.planes[:, :3].T - obstacle.planes[:, 3]
            distance = (normals @ flat + shift[:, :, 0, :, None]).max(axis=2).min(axis=1)
            out[rows] = np.minimum(out[rows], distance.reshape(len(rows), *points.shape[:2]).min(axis=2))
    return out


_points: LRUCache[str, Floats] = LRUCache(8)
_lock = threading.Lock()


def points_of(mounting: HandModel) -> Floats:
    """(W, M, 3) points of a mounting at each wrist position, the `OUTERMOST` first, frame of the root [m]."""
    with _lock:
        if (found := _points.get(mounting.content)) is None:
            wrists = wrist_positions(mounting)
            bodies = body_poses(mounting, np.tile(IDENTITY_POSE, (len(wrists), 1)), mounting.expand(wrists))
            corners = [apply(bodies[:, p.body, None], p.vertices) for p in mounting.pieces]
            every = np.concatenate(corners, axis=1)
            far = (every @ spread_directions(OUTERMOST).T).argmax(axis=1)
            spread = every[:, farthest_points(every[0], min(SPREAD, every.shape[1]))]
            outermost = np.take_along_axis(every, far[..., None], axis=1)
            found = _points[mounting.content] = np.concatenate([outermost, spread], axis=1)
        return found


def wrist_room(
    mounting: HandModel, poses: Floats, wrist: Floats, scenes: Sequence[Environment], which: NDArray[np.integer[Any]]
) -> Floats:
    """(N,) least distance of mountings from the obstacles of scenes `which` (N,) at root poses (N, P, 7) and wrist
    angles (N, K) [m]."""
    steps = poses.shape[1]
    joints = np.repeat(mounting.expand(wrist), steps, axis=0)
    postures = Posture(poses.reshape(-1, 7), joints)
    return obstacle_room(mounting, postures, scenes, np.repeat(which, steps)).reshape(len(poses), steps).min(axis=1)
