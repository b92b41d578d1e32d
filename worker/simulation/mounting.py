"""Distance of a hand's mounting from obstacles: of the wrist angles that it may take, those nearest to rest count that
keep it clear."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from worker.grasps import Posture
from worker.hands.model import HandModel
from worker.hands.mounting import wrist_positions
from worker.simulation.obstacles import MARGIN_M, obstacle_room
from worker.simulation.surroundings import CLEAR_M, Surroundings

Floats = NDArray[np.float64]


def mounting_room(
    hand: HandModel,
    poses: Floats,
    scenes: Sequence[Surroundings],
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
        (N, K) wrist angles: the first of `wrist_positions` with room enough, or else those with the most; and (N,) the
        least distance of the mounting from obstacles at all poses [m]. Without a mounting K is 0 and the distance inf.
    """
    mounting, count = hand.mounting, len(poses)
    if mounting is None:
        return np.zeros((count, 0)), np.full(count, np.inf)
    which = np.zeros(count, np.intp) if which is None else which
    wrists = wrist_positions(mounting)
    chosen, room = np.tile(wrists[0], (count, 1)), np.full(count, -np.inf)
    for tried in (wrists[:1], wrists[1:]):
        rows = np.flatnonzero(room < enough)
        if not len(rows) or not len(tried):
            break
        found = wrist_room(mounting, np.repeat(poses[rows], len(tried), axis=0), np.tile(tried, (len(rows), 1)),
                           scenes, np.repeat(which[rows], len(tried))).reshape(len(rows), -1)  # fmt: skip
        clear = found >= enough
        best = np.where(clear.any(axis=1), clear.argmax(axis=1), found.argmax(axis=1))
        most = found[np.arange(len(rows)), best]
        better = most > room[rows]
        chosen[rows[better]], room[rows[better]] = tried[best[better]], most[better]
    return chosen, room


def wrist_room(
    mounting: HandModel, poses: Floats, wrist: Floats, scenes: Sequence[Surroundings], which: NDArray[np.integer[Any]]
) -> Floats:
    """(N,) least distance of mountings from the obstacles of scenes `which` (N,) at root poses (N, P, 7) and wrist
    angles (N, K) [m]."""
    steps = poses.shape[1]
    joints = np.repeat(mounting.expand(wrist), steps, axis=0)
    postures = Posture(poses.reshape(-1, 7), joints)
    return obstacle_room(mounting, postures, scenes, np.repeat(which, steps)).reshape(len(poses), steps).min(axis=1)


def mounting_lack(
    hand: HandModel,
    poses: Floats,
    scenes: Sequence[Surroundings],
    which: NDArray[np.integer[Any]],
    *,
    room: float = 0.0,
) -> Floats:
    """(N,) what mountings lack of the distance that planners keep from obstacles, and of `room` besides, at root poses
    (N, 7) and the best wrist angles [m]; 0 or more."""
    wanted = MARGIN_M + room
    return np.maximum(0.0, wanted - mounting_room(hand, poses[:, None], scenes, which, enough=wanted)[1])
