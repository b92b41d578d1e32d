"""Grasps as the columns of a base shard."""

from __future__ import annotations

from typing import Any

from service.store.shards import Attribute
from worker.grasps import GraspSet


def verdict_attributes(level: str, key: str | None) -> dict[str, Attribute]:
    """Who judged the grasps of a base shard: the level and its key, or none."""
    return {"verdict_level": "none"} if key is None else {"verdict_level": level, "verdict_key": key}


def postures(grasps: GraspSet) -> dict[str, Any]:
    """The posture columns of a base shard."""
    parts = {"grasp": grasps.grasp, "pregrasp": grasps.pregrasp, "squeeze": grasps.squeeze}
    columns: dict[str, Any] = {f"{name}/hand_pose": part.hand_pose for name, part in parts.items()}
    columns |= {f"{name}/joint_positions": part.joint_positions for name, part in parts.items()}
    if grasps.scene is not None and grasps.approach is not None and grasps.lift is not None:
        columns |= {
            "grasp/scene_index": grasps.scene, "grasp/approach": grasps.approach,
            "grasp/approach_joint_positions": grasps.coming, "grasp/lift": grasps.lift.hand_pose,
        }  # fmt: skip
    return columns
