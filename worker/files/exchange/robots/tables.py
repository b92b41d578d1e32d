"""Grasps as three tables of comma-separated values: the grasps, their postures, their trajectories.

Poses are those of the tool frame: x y z [m], unit quaternion qw qx qy qz. Joints are radians or metres, in columns that
bear their names.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from service.model.transforms import POSE_PARTS
from worker.files.exchange.robots.bundle import Bundle, numbers
from worker.robots.execution import POSTURES


def write(bundle: Bundle, folder: Path) -> list[Path]:
    """Write `grasps.csv`, `postures.csv` and `trajectories.csv`."""
    folder.mkdir(parents=True, exist_ok=True)
    joints = bundle.found.hand.joint_names
    of_trajectory = bundle.trajectories[0].joint_names
    return [
        _table(
            folder / "grasps.csv",
            (
                "grasp",
                "row",
                "frame",
                "tool_frame",
                "scene",
                "valid",
                "success",
                "epsilon",
                *(f"object_{part}" for part in POSE_PARTS),
            ),
            _grasps(bundle),
        ),
        _table(folder / "postures.csv", ("grasp", "posture", *POSE_PARTS, *joints), _postures(bundle)),
        _table(
            folder / "trajectories.csv",
            ("grasp", "phase", "time_s", *POSE_PARTS, *of_trajectory),
            _trajectories(bundle),
        ),
    ]


def _grasps(bundle: Bundle) -> Iterable[list[Any]]:
    found = bundle.found
    for row in range(len(found)):
        scene = "" if found.placed is None else int(found.placed.index[row])
        judged = [int(found.quality["valid"][row]), int(found.quality["success"][row])]
        yield [
            bundle.name(row),
            int(found.rows[row]),
            bundle.frame,
            found.tool.name,
            scene,
            *judged,
            *numbers(found.quality["epsilon"][row]),
            *numbers(bundle.seen(found.object_pose[row])),
        ]


def _postures(bundle: Bundle) -> Iterable[list[Any]]:
    for row in range(len(bundle.found)):
        for name in POSTURES:
            part = bundle.found.postures[name]
            pose = bundle.seen_tool(part.hand_pose[row])
            yield [bundle.name(row), name, *numbers(pose), *numbers(part.joint_positions[row])]


def _trajectories(bundle: Bundle) -> Iterable[list[Any]]:
    for row, path in enumerate(bundle.trajectories):
        poses = bundle.seen_tool(path.hand_pose)
        for phase, time, pose, joints in zip(path.phase, path.time, poses, path.joints, strict=True):
            yield [bundle.name(row), phase, *numbers(time), *numbers(pose), *numbers(joints)]


def _table(file: Path, heading: Sequence[str], rows: Iterable[list[Any]]) -> Path:
    with file.open("w", newline="", encoding="utf-8") as opened:
        writer = csv.writer(opened)
        writer.writerow(heading)
        writer.writerows(rows)
    return file
