"""The grasp file of Isaac Sim's grasp editor (`isaac_grasp`, version 1.0), which Isaac ROS and cuMotion read too.

A grasp is the pose of the gripper's frame in the object's: position [m], quaternion w and xyz; `cspace_position` are
the joints that hold, `pregrasp_cspace_position` those before. Joints that the URDF couples are left out. The two frames
are told to people only; Isaac Sim's page calls them `..._frame_link`, that of Isaac ROS `..._frame`: both stand there.
Commanded joints that press, and the way, are under a key of our own, which readers pass over.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np

from service.model.transforms import compose, invert
from worker.files.exchange.names import plain_name, prim_name
from worker.files.exchange.robots.bundle import Bundle, dump_yaml, numbers

FORMAT: Final = {"format": "isaac_grasp", "format_version": "1.0"}


def write(bundle: Bundle, folder: Path) -> list[Path]:
    """Write `HAND_OBJECT.yaml`."""
    found = bundle.found
    folder.mkdir(parents=True, exist_ok=True)
    thing, hand = (f"/World/{name}" for name in bundle.prims)
    tool = f"{hand}/{prim_name(found.tool.name)}"
    document = {
        **FORMAT,
        "object_frame_link": thing,
        "gripper_frame_link": tool,
        "object_frame": thing,
        "gripper_frame": tool,
        "grasps": {bundle.name(row): _grasp(bundle, row) for row in range(len(found))},
    }
    file = folder / f"{plain_name(found.hand.name)}_{plain_name(found.obj.name)}.yaml"
    return [dump_yaml(file, document)]


def _grasp(bundle: Bundle, row: int) -> dict[str, Any]:
    found = bundle.found

    def pose(posture: str) -> dict[str, Any]:
        x, y, z, w, *xyz = numbers(compose(invert(found.object_pose[row]), found.tool_pose(posture)[row]))
        return {"position": [x, y, z], "orientation": {"w": w, "xyz": xyz}}

    def joints(posture: str) -> dict[str, float]:
        values = numbers(found.postures[posture].joint_positions[row])
        return {found.hand.joint_names[k]: values[k] for k in bundle.steered}

    return {
        "confidence": 1.0 if found.quality["valid"][row] else 0.0,
        **pose("grasp"),
        "cspace_position": joints("grasp"),
        "pregrasp_cspace_position": joints("pregrasp"),
        "graspd": {
            "squeeze_cspace_position": joints("squeeze"),
            "open_cspace_position": joints("standoff"),
            "standoff": pose("standoff"),
            "pregrasp": pose("pregrasp"),
            "lift": pose("lift"),
            "epsilon": numbers(np.asarray(found.quality["epsilon"][row]))[0],
        },
    }
