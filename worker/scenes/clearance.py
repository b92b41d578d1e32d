"""Grasps on a table: base grasps moved by the object's rest pose, checked exactly against the table."""

from dataclasses import replace
from enum import IntEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.errors import InputError
from graspd.service.model.transforms import Floats, compose
from graspd.worker.grasps import Posture
from graspd.worker.hands.model import HandModel
from graspd.worker.scenes.neighbours import Neighbours, neighbour_clearance
from graspd.worker.simulation.environment import CLEAR_M, UP, Environment, Obstacle
from graspd.worker.simulation.mounting import choose_wrist, wrist_clearance
from graspd.worker.simulation.obstacles import PosedFeatures

#: Least clearance of the hand above the table [m].
MARGIN_M: Final = CLEAR_M
#: Postures checked on the straight trajectory from pregrasp to grasp, both ends included.
PATH_POSTURES: Final = 9
_CHUNK: Final = 64
_TABLE: Final = Obstacle.half_space(UP, 0.0)


class Rejection(IntEnum):
    """Reason to reject a grasp in a scene; the first of several applicable reasons."""

    NONE = 0
    TABLE_AT_CONTACT = 1
    TABLE_ON_APPROACH = 2
    NEIGHBOUR_AT_CONTACT = 3
    NEIGHBOUR_ON_APPROACH = 4


def transfer_grasps(
    hand: HandModel, grasp: Posture, pregrasp: Posture, object_pose: Floats, neighbours: Neighbours | None = None
) -> dict[str, NDArray[np.generic]]:
    """Transfer every grasp to every scene and compute the clearance of the hand and its mounting.
    Grasps and pregrasps are N postures in the object frame, joined by straight motions. `object_pose` (S, 7) are rest
    poses in the table frame. The wrist of a mounting takes the first angles that clear the table, neighbours ignored.
    Raises InputError: grasps and pregrasps differ in number.

    Returns:
        Columns of the scene shard with K = S N rows, scene by scene: `grasp/base_index`, `grasp/scene_index`,
        `grasp/hand_pose` (K, 7). `grasp/table_clearance_m` (K,) is the height of the hand's lowest point from pregrasp
        to grasp, `grasp/contact_table_clearance_m` (K,) its height at the grasp alone. `grasp/valid` (K,) is 1 where
        all clearances are at least `MARGIN_M`; `grasp/rejection` (K,) is a `Rejection`. With neighbours also
        `grasp/neighbour_clearance_m` (K,); for hands on a wrist also `grasp/wrist_positions` (K, U)."""
    if len(grasp) != len(pregrasp):
        raise InputError(f"{len(grasp)} grasps come with {len(pregrasp)} pregrasps; each grasp needs its own")
    poses = np.asarray(object_pose, float).reshape(-1, 7)
    joints = 0 if hand.mounting is None else hand.mounting.dofs
    clearance, wrist = np.zeros((len(poses), len(grasp), 2)), np.zeros((len(poses), len(grasp), joints))
    for part in np.array_split(np.arange(len(grasp)), -(-len(grasp) // _CHUNK)) if len(grasp) else ():
        some, before = grasp.take(part), pregrasp.take(part)
        wrist[:, part], mounted = _mounting_clearance(hand, some, before, poses)
        clearance[:, part] = np.minimum(_table_clearance(hand, some, before, poses), mounted)
    scenes, grasps = len(poses), len(grasp)
    at_contact, on_the_way = clearance.reshape(-1, 2).T
    rejection = np.where(on_the_way < MARGIN_M, Rejection.TABLE_ON_APPROACH, Rejection.NONE)
    rejection[at_contact < MARGIN_M] = Rejection.TABLE_AT_CONTACT
    result: dict[str, NDArray[np.generic]] = {}
    if neighbours is not None:
        beside = _neighbour_clearance(hand, grasp, pregrasp, poses, neighbours, wrist).reshape(-1, 2)
        rejection[(rejection == Rejection.NONE) & (beside[:, 1] < MARGIN_M)] = Rejection.NEIGHBOUR_ON_APPROACH
        blocked = (rejection >= Rejection.NEIGHBOUR_AT_CONTACT) & (beside[:, 0] < MARGIN_M)
        rejection[blocked] = Rejection.NEIGHBOUR_AT_CONTACT
        result["grasp/neighbour_clearance_m"] = beside[:, 1]
    if joints:
        result["grasp/wrist_positions"] = wrist.reshape(-1, joints)
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
    """Count the rejected grasps by reason."""
    return {r.name.lower(): int((rejection == r).sum()) for r in Rejection if r is not Rejection.NONE}


def approach_postures(grasp: Posture, pregrasp: Posture, postures: int = PATH_POSTURES) -> Posture:
    """Return N * `postures` postures on the straight trajectory from each pregrasp to its grasp.
    Positions and joints move linearly, orientations along the shorter arc (normalised linear interpolation)."""
    t = np.linspace(0.0, 1.0, postures)[None, :, None]
    start, end = pregrasp.hand_pose[:, None], grasp.hand_pose[:, None]
    sign = np.where((start[..., 3:] * end[..., 3:]).sum(-1, keepdims=True) < 0, -1.0, 1.0)
    target = np.concatenate([end[..., :3], sign * end[..., 3:]], axis=-1)
    pose = (1 - t) * start + t * target
    pose[..., 3:] /= np.linalg.norm(pose[..., 3:], axis=-1, keepdims=True)
    joints = (1 - t) * pregrasp.joint_positions[:, None] + t * grasp.joint_positions[:, None]
    return Posture(pose.reshape(-1, 7), joints.reshape(-1, joints.shape[-1]))


def _neighbour_clearance(
    hand: HandModel, grasp: Posture, pregrasp: Posture, poses: Floats, neighbours: Neighbours, wrist: Floats
) -> Floats:
    """Return clearances (S, N, 2) of hands and mountings from neighbours: at contact and on the approach.
    Mountings are at wrist angles (S, N, K)."""
    path = approach_postures(grasp, pregrasp)
    distance = neighbour_clearance(hand, path, poses, neighbours)
    if hand.mounting is not None:
        for s, angles in enumerate(wrist):
            mounted = Posture(path.hand_pose, hand.mounting.expand(np.repeat(angles, PATH_POSTURES, axis=0)))
            here = replace(neighbours, poses=np.asarray(neighbours.poses)[s : s + 1])
            gaps = neighbour_clearance(hand.mounting, mounted, poses[s : s + 1], here)
            distance[s] = np.minimum(distance[s], gaps[0])
    distance = distance.reshape(len(poses), len(grasp), -1)
    return np.stack([distance[..., -1], distance.min(axis=2)], axis=-1)


def _table_clearance(hand: HandModel, grasp: Posture, pregrasp: Posture, object_pose: Floats) -> Floats:
    """Return heights (S, N, 2) of the hand's lowest point at contact and on approach, table frame [m]."""
    features = PosedFeatures.create(hand, approach_postures(grasp, pregrasp))
    on_path = np.array([features.distance(_TABLE.in_frame(pose)).min(axis=1) for pose in object_pose])
    on_path = on_path.reshape(len(object_pose), len(grasp), -1)
    return np.stack([on_path[..., -1], on_path.min(axis=2)], axis=-1)


def _mounting_clearance(
    hand: HandModel, grasp: Posture, pregrasp: Posture, object_pose: Floats
) -> tuple[Floats, Floats]:
    """Return wrist angles (S, N, K) and lowest heights (S, N, 2) of the mounting [m]; inf without it.
    The heights are those at contact and on the approach, as in `_table_clearance`."""
    path = approach_postures(grasp, pregrasp).hand_pose.reshape(len(grasp), PATH_POSTURES, 7)
    angles, heights, which = [], [], np.zeros(len(grasp), np.intp)
    for pose in object_pose:
        table = [Environment((_TABLE.in_frame(pose),), UP)]
        wrist, on_path = choose_wrist(hand, path, table)
        at_contact = on_path
        if hand.mounting is not None:
            at_contact = wrist_clearance(hand.mounting, path[:, -1:], wrist, table, which)
        angles.append(wrist)
        heights.append(np.stack([at_contact, on_path], axis=-1))
    return np.array(angles), np.array(heights)
