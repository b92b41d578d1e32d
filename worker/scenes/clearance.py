"""Grasps on a table: base grasps moved by the object's rest pose and checked against the table, exactly."""

from __future__ import annotations

from enum import IntEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from service.model.errors import InputError
from service.model.transforms import compose
from worker.grasps import Posture
from worker.hands.model import Floats, HandModel
from worker.scenes.neighbours import Neighbours, neighbour_clearance
from worker.simulation.obstacles import PosedFeatures
from worker.simulation.surroundings import CLEAR_M, UP, Obstacle

#: A grasp is kept if the hand stays at least this far above the table [m].
MARGIN_M: Final = CLEAR_M
#: Postures checked on the straight way from pregrasp to grasp, both ends included.
PATH_POSTURES: Final = 9
_CHUNK: Final = 64
_TABLE: Final = Obstacle.half_space(UP, 0.0)


class Rejection(IntEnum):
    """Why a grasp is no grasp of a scene; of several reasons the first in this order."""

    NONE = 0
    TABLE_AT_CONTACT = 1
    TABLE_ON_APPROACH = 2
    NEIGHBOUR_AT_CONTACT = 3
    NEIGHBOUR_ON_APPROACH = 4


def transfer(
    hand: HandModel,
    grasp: Posture,
    pregrasp: Posture,
    object_pose: Floats,
    neighbours: Neighbours | None = None,
) -> dict[str, NDArray[np.generic]]:
    """Every grasp in every scene, with the hand's clearance above the table.

    Args:
        hand: the hand.
        grasp: N postures at contact, object frame.
        pregrasp: N postures before contact, object frame; the hand moves straight from it to the grasp.
        object_pose: (S, 7) rest poses in the table frame.
        neighbours: other objects on the table that the hand must stay clear of, too.

    Returns:
        Datasets of the scene shard with K = S N rows, scene-major: `grasp/base_index`, `grasp/scene_index`,
        `grasp/hand_pose` (K, 7), `grasp/table_clearance_m` (K,): lowest point of the hand at the grasp, the pregrasp
        and between them; `grasp/contact_table_clearance_m` (K,): the same at the grasp alone; `grasp/valid` (K,): 1
        where both are at least `MARGIN_M`; `grasp/rejection` (K,): a `Rejection`. With neighbours
        also `grasp/neighbour_clearance_m` (K,).

    Raises:
        InputError: grasps and pregrasps differ in number.
    """
    if len(grasp) != len(pregrasp):
        raise InputError(f"{len(grasp)} grasps come with {len(pregrasp)} pregrasps; each grasp needs its own")
    poses = np.asarray(object_pose, float).reshape(-1, 7)
    clearance = np.concatenate(
        [np.empty((len(poses), 0, 2))]
        + [
            _clearance(hand, grasp.take(part), pregrasp.take(part), poses)
            for part in np.array_split(np.arange(len(grasp)), max(1, -(-len(grasp) // _CHUNK)))
            if len(part)
        ],
        axis=1,
    )
    scenes, grasps = len(poses), len(grasp)
    at_contact, on_the_way = clearance.reshape(-1, 2).T
    rejection = np.where(on_the_way < MARGIN_M, Rejection.TABLE_ON_APPROACH, Rejection.NONE)
    rejection[at_contact < MARGIN_M] = Rejection.TABLE_AT_CONTACT
    result: dict[str, NDArray[np.generic]] = {}
    if neighbours is not None:
        beside = _beside(hand, grasp, pregrasp, poses, neighbours).reshape(-1, 2)
        rejection[(rejection == Rejection.NONE) & (beside[:, 1] < MARGIN_M)] = Rejection.NEIGHBOUR_ON_APPROACH
        rejection[(rejection >= Rejection.NEIGHBOUR_AT_CONTACT) & (beside[:, 0] < MARGIN_M)] = (
            Rejection.NEIGHBOUR_AT_CONTACT
        )
        result["grasp/neighbour_clearance_m"] = beside[:, 1]
    return result | {
        "grasp/base_index": np.tile(np.arange(grasps, dtype=np.int32), scenes),
        "grasp/scene_index": np.repeat(np.arange(scenes, dtype=np.int32), grasps),
        "grasp/hand_pose": compose(poses[:, None], grasp.hand_pose[None]).reshape(-1, 7),
        "grasp/table_clearance_m": on_the_way,
        "grasp/contact_table_clearance_m": at_contact,
        "grasp/rejection": rejection.astype(np.uint8),
        "grasp/valid": (rejection == Rejection.NONE).astype(np.uint8),
    }


def count_rejections(rejection: NDArray[np.uint8]) -> dict[str, int]:
    """How many grasps each reason refused."""
    return {r.name.lower(): int((rejection == r).sum()) for r in Rejection if r is not Rejection.NONE}


def approach(grasp: Posture, pregrasp: Posture, postures: int = PATH_POSTURES) -> Posture:
    """(N * postures) postures on the straight way from each pregrasp (first) to its grasp (last).

    Positions and joints move linearly, orientations along the shorter arc (normalised linear interpolation).
    """
    t = np.linspace(0.0, 1.0, postures)[None, :, None]
    start, end = pregrasp.hand_pose[:, None], grasp.hand_pose[:, None]
    sign = np.where((start[..., 3:] * end[..., 3:]).sum(-1, keepdims=True) < 0, -1.0, 1.0)
    target = np.concatenate([end[..., :3], sign * end[..., 3:]], axis=-1)
    pose = (1 - t) * start + t * target
    pose[..., 3:] /= np.linalg.norm(pose[..., 3:], axis=-1, keepdims=True)
    joints = (1 - t) * pregrasp.joint_positions[:, None] + t * grasp.joint_positions[:, None]
    return Posture(pose.reshape(-1, 7), joints.reshape(-1, joints.shape[-1]))


def _beside(hand: HandModel, grasp: Posture, pregrasp: Posture, poses: Floats, neighbours: Neighbours) -> Floats:
    """(S, N, 2) distance from the neighbours at contact, and the smallest on the way."""
    path = approach(grasp, pregrasp)
    distance = neighbour_clearance(hand, path, poses, neighbours).reshape(len(poses), len(grasp), -1)
    return np.stack([distance[..., -1], distance.min(axis=2)], axis=-1)


def _clearance(hand: HandModel, grasp: Posture, pregrasp: Posture, object_pose: Floats) -> Floats:
    """(S, N, 2) lowest point of the hand at contact, and anywhere on its way, in the table frame [m]."""
    features = PosedFeatures.of(hand, approach(grasp, pregrasp))
    on_path = np.array([features.distance(_TABLE.seen_from(pose)).min(axis=1) for pose in object_pose])
    on_path = on_path.reshape(len(object_pose), len(grasp), -1)
    return np.stack([on_path[..., -1], on_path.min(axis=2)], axis=-1)
