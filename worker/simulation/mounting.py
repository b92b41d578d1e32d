"""Clearance of a hand's mounting (links above its root) from obstacles, and choice of wrist angles.
Planners use the clearance of the mounting's points, which is cheap; validity uses the exact clearance."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.transforms import IDENTITY_POSE, Floats, apply, quat_conjugate, quat_rotate, spread_directions
from graspd.worker.grasps import Posture
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.mounting import wrist_positions
from graspd.worker.hands.surface import farthest_points
from graspd.worker.objects.memory_cache import cached_by_content
from graspd.worker.simulation.environment import CLEAR_M, Environment
from graspd.worker.simulation.obstacles import MARGIN_M, obstacle_clearance

#: Points of a mounting: the outermost ones in this many directions, and this many corners spread over the mounting.
OUTERMOST: Final = 20
SPREAD: Final = 40
TRIES: Final = 4  # largest number of wrist positions of a hand whose exact clearance is computed


def choose_wrist(
    hand: HandModel, poses: Floats, scenes: Sequence[Environment], which: NDArray[np.integer[Any]] | None = None
) -> tuple[Floats, Floats]:
    """Choose wrist angles that stay constant while the hand moves; return the mounting's clearance.
    `poses` (N, P, 7) are root poses of N hands, object frame; `which` (N,) is the scene of each hand, by default the
    first. Return wrist angles (N, K): the first of `wrist_positions` with a clearance of `CLEAR_M`, else the clearest
    one tried. At most `TRIES` angles with clear points are tried; one if no points are clear. Also return the least
    clearance (N,) of the mounting from obstacles at all poses [m]. Without a mounting K is 0 and the clearance inf."""
    mounting, count = hand.mounting, len(poses)
    if mounting is None:
        return np.zeros((count, 0)), np.full(count, np.inf)
    scene_of = np.zeros(count, np.intp) if which is None else which.astype(np.intp)
    return _solve_wrist(mounting, poses, scenes, scene_of, point_clearance(mounting, poses, scenes, scene_of), CLEAR_M)


def missing_mounting_clearance(
    hand: HandModel,
    poses: Floats,
    scenes: Sequence[Environment],
    which: NDArray[np.integer[Any]],
    *,
    room: float = 0.0,
    exact: bool = True,
) -> Floats:
    """Return by how much (N,) mountings miss a clearance of `MARGIN_M` + `room` [m], at least 0.
    `poses` (N, 7) are root poses; wrists have their best angles. Unless `exact`, only points are checked."""
    mounting, wanted = hand.mounting, MARGIN_M + room
    if mounting is None or not len(poses):
        return np.zeros(len(poses))
    poses, scene_of = poses[:, None], which.astype(np.intp)
    points = point_clearance(mounting, poses, scenes, scene_of)
    most = points.max(axis=1)
    rows = np.flatnonzero(exact & (most >= wanted))
    if len(rows):
        _, most[rows] = _solve_wrist(mounting, poses[rows], scenes, scene_of[rows], points[rows], wanted)
    return np.asarray(np.maximum(0.0, wanted - most))


def _solve_wrist(
    mounting: HandModel,
    poses: Floats,
    scenes: Sequence[Environment],
    which: NDArray[np.intp],
    points: Floats,
    enough: float,
) -> tuple[Floats, Floats]:
    """Return angles and clearance as `choose_wrist` does; overwrite the clearance of `points` (N, W)."""
    wrists, count = wrist_positions(mounting), len(poses)
    number, room, rows = np.zeros(count, np.intp), np.full(count, -np.inf), np.arange(count)
    for _ in range(min(TRIES, len(wrists))):
        hopeful = points[rows] >= enough
        tried = np.where(hopeful.any(axis=1), hopeful.argmax(axis=1), points[rows].argmax(axis=1))
        found = wrist_clearance(mounting, poses[rows], wrists[tried], scenes, which[rows])
        better = found > room[rows]
        number[rows[better]], room[rows[better]] = tried[better], found[better]
        points[rows, tried] = -np.inf
        rows = rows[(room[rows] < enough) & (points[rows] >= enough).any(axis=1)]
        if not len(rows):
            break
    return wrists[number], room


def point_clearance(
    mounting: HandModel, poses: Floats, scenes: Sequence[Environment], which: NDArray[np.intp]
) -> Floats:
    """Return the points' least clearance (N, W) [m] over root poses (N, P, 7), at W wrist positions.
    Scenes are `which` (N,). The mounting's own clearance is at most this, except near edges and corners of solids."""
    points = mounting_points(mounting)
    out = np.full((len(poses), len(points)), np.inf)
    for scene in np.unique(which):
        rows = np.flatnonzero(which == scene)
        place, flat = poses[rows][:, :, None], points.reshape(-1, 3).T
        for obstacle in scenes[scene].obstacles:
            # Planes are transformed to the root frame, because points are many and planes few.
            normals = quat_rotate(quat_conjugate(place[..., 3:]), obstacle.planes[:, :3])
            shift = place[..., :3] @ obstacle.planes[:, :3].T - obstacle.planes[:, 3]
            distance = (normals @ flat + shift[:, :, 0, :, None]).max(axis=2).min(axis=1)
            out[rows] = np.minimum(out[rows], distance.reshape(len(rows), *points.shape[:2]).min(axis=2))
    return out


@cached_by_content(8)
def mounting_points(mounting: HandModel) -> Floats:
    """Return points (W, M, 3) of a mounting at each wrist position, the `OUTERMOST` first, root frame [m]."""
    wrists = wrist_positions(mounting)
    bodies = body_poses(mounting, np.tile(IDENTITY_POSE, (len(wrists), 1)), mounting.expand(wrists))
    every = np.concatenate([apply(bodies[:, p.body, None], p.vertices) for p in mounting.pieces], axis=1)
    far = (every @ spread_directions(OUTERMOST).T).argmax(axis=1)
    spread = every[:, farthest_points(every[0], min(SPREAD, every.shape[1]))]
    return np.concatenate([np.take_along_axis(every, far[..., None], axis=1), spread], axis=1)


def wrist_clearance(
    mounting: HandModel, poses: Floats, wrist: Floats, scenes: Sequence[Environment], which: NDArray[np.integer[Any]]
) -> Floats:
    """Return the least clearance (N,) [m] in scenes `which`, over root poses (N, P, 7), at wrists (N, K)."""
    steps = poses.shape[1]
    joints = np.repeat(mounting.expand(wrist), steps, axis=0)
    postures = Posture(poses.reshape(-1, 7), joints)
    clearance = obstacle_clearance(mounting, postures, scenes, np.repeat(which, steps))
    return clearance.reshape(len(poses), steps).min(axis=1)
