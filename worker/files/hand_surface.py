"""The hand of a shard as points on its surface in each grasp: what tells which points of an object it touches."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from cachetools import LRUCache, cached
from numpy.typing import NDArray

from service.model.transforms import Floats, apply
from service.store.shards import Shard
from worker.files.of_shard import hand_of_shard
from worker.hands.kinematics import body_poses
from worker.hands.model import HandModel
from worker.hands.surface import sample_surface

#: Points on a hand: some 5 mm apart on one as large as a man's.
POINTS: Final = 2048
_hands: LRUCache[Any, HandModel] = LRUCache(8)


def hand_surface(shard: Shard, rows: NDArray[np.intp]) -> Floats:
    """(K, H, 3) points on the hand's surface at contact in the object's frame [m].

    Args:
        shard: a base shard.
        rows: (K,) its grasps.

    Raises:
        NotFoundError: the hand that the shard was made with is not here.
    """
    hand = _hand(shard)
    points = sample_surface(hand, POINTS)
    pose, joints = (np.asarray(shard[f"grasp/{part}"], float)[rows] for part in ("hand_pose", "joint_positions"))
    return apply(body_poses(hand, pose, joints)[:, points.body], points.position)


@cached(_hands, key=lambda shard: shard.attributes["hand_digest"])
def _hand(shard: Shard) -> HandModel:
    return hand_of_shard(shard, None)
