"""Grasps as text files: three CSV tables, and Isaac Sim's grasp file (`isaac_grasp`, version 1.0).

Poses are those of the tool frame; joint columns [rad or m] have the joints' names. Isaac Sim's file omits joints that
the URDF couples. Isaac Sim uses frame names `..._frame_link`, Isaac ROS `..._frame`, so the file has both. Further
postures and epsilon are under the key `graspd`, which readers ignore."""

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from graspd.exchange.plan import plain_name, prim_name
from graspd.exchange.robots.bundle import Bundle, dump_yaml, rounded_numbers
from graspd.service.model.transforms import POSE_PARTS, compose, invert
from graspd.worker.episodes.execution import POSTURES


def write_tables(bundle: Bundle, folder: Path) -> list[Path]:
    """Write `grasps.csv`, `postures.csv` and `trajectories.csv`."""
    folder.mkdir(parents=True, exist_ok=True)
    joints = bundle.found.hand.joint_names
    of_trajectory = bundle.trajectories[0].joint_names
    facts = ("row", "frame", "tool_frame", "scene", "valid", "success", "epsilon")
    of_object = (f"object_{part}" for part in POSE_PARTS)
    moving = ("grasp", "phase", "time_s", *POSE_PARTS, *of_trajectory)
    return [
        _write_csv(folder / "grasps.csv", ("grasp", *facts, *of_object), _grasps(bundle)),
        _write_csv(folder / "postures.csv", ("grasp", "posture", *POSE_PARTS, *joints), _postures(bundle)),
        _write_csv(folder / "trajectories.csv", moving, _trajectories(bundle)),
    ]


def _grasps(bundle: Bundle) -> Iterable[list[Any]]:
    found = bundle.found
    for row in range(len(found)):
        scene = "" if found.placed is None else int(found.placed.index[row])
        place = [bundle.grasp_name(row), int(found.rows[row]), bundle.frame, found.tool.name, scene]
        verdicts = [int(found.quality[name][row]) for name in ("valid", "success")]
        pose = rounded_numbers(bundle.to_frame(found.object_pose[row]))
        yield [*place, *verdicts, *rounded_numbers(found.quality["epsilon"][row]), *pose]


def _postures(bundle: Bundle) -> Iterable[list[Any]]:
    for row in range(len(bundle.found)):
        for name in POSTURES:
            part = bundle.found.postures[name]
            pose = bundle.tool_in_frame(part.hand_pose[row])
            yield [bundle.grasp_name(row), name, *rounded_numbers(pose), *rounded_numbers(part.joint_positions[row])]


def _trajectories(bundle: Bundle) -> Iterable[list[Any]]:
    for row, path in enumerate(bundle.trajectories):
        poses = bundle.tool_in_frame(path.hand_pose)
        for phase, time, pose, joints in zip(path.phase, path.time, poses, path.joints, strict=True):
            yield [
                bundle.grasp_name(row),
                phase,
                *rounded_numbers(time),
                *rounded_numbers(pose),
                *rounded_numbers(joints),
            ]


def _write_csv(file: Path, heading: Sequence[str], rows: Iterable[list[Any]]) -> Path:
    with file.open("w", newline="", encoding="utf-8") as opened:
        writer = csv.writer(opened)
        writer.writerow(heading)
        writer.writerows(rows)
    return file


FORMAT: Final = {"format": "isaac_grasp", "format_version": "1.0"}


def write_isaac(bundle: Bundle, folder: Path) -> list[Path]:
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
        "grasps": {bundle.grasp_name(row): _grasp(bundle, row) for row in range(len(found))},
    }
    file = folder / f"{plain_name(found.hand.name)}_{plain_name(found.obj.name)}.yaml"
    return [dump_yaml(file, document)]


def _grasp(bundle: Bundle, row: int) -> dict[str, Any]:
    found = bundle.found

    def pose(posture: str) -> dict[str, Any]:
        x, y, z, w, *xyz = rounded_numbers(compose(invert(found.object_pose[row]), found.tool_pose(posture)[row]))
        return {"position": [x, y, z], "orientation": {"w": w, "xyz": xyz}}

    def joints(posture: str) -> dict[str, float]:
        values = rounded_numbers(found.postures[posture].joint_positions[row])
        return {found.hand.joint_names[k]: values[k] for k in bundle.commanded_joints}

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
            "epsilon": rounded_numbers(np.asarray(found.quality["epsilon"][row]))[0],
        },
    }
