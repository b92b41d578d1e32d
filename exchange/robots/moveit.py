"""Grasps as `moveit_msgs/Grasp` and `RobotTrajectory` messages in YAML, with URDFs of hand and object.

Poses are those of the tool frame, MoveIt's end-effector link. `effort` is stiffness times distance from the grasp."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from graspd.exchange.imported import urdf_text, write_mesh
from graspd.exchange.plan import plain_name
from graspd.exchange.robots.bundle import Bundle, dump_yaml, rounded_numbers
from graspd.service.model.transforms import Floats
from graspd.worker.episodes.execution import RobotTrajectory

#: Share of a straight motion that MoveIt must be able to make for a grasp (`min_distance`).
LEAST_SHARE: Final = 0.5


def write(bundle: Bundle, folder: Path, hand_files: Mapping[str, bytes]) -> list[Path]:
    """Write `grasps.yaml`, `trajectories/GRASP.yaml`, and URDFs and meshes to `hand/` and `object/`."""
    (folder / "trajectories").mkdir(parents=True, exist_ok=True)
    written = [dump_yaml(folder / "grasps.yaml", [_grasp(bundle, row) for row in range(len(bundle.found))])]
    for row, trajectory in enumerate(bundle.trajectories):
        file = folder / "trajectories" / f"{bundle.grasp_name(row)}.yaml"
        written.append(dump_yaml(file, _trajectory(bundle, trajectory)))
    return written + _write_hand(folder / "hand", hand_files) + _write_object(bundle, folder / "object")


def _grasp(bundle: Bundle, row: int) -> dict[str, Any]:
    found = bundle.found
    postures = found.postures
    names = [found.hand.joint_names[k] for k in bundle.commanded_joints]

    def point(posture: str, seconds: float, effort: Floats | None = None) -> dict[str, Any]:
        return _trajectory_point(
            postures[posture].joint_positions[row, bundle.commanded_joints], seconds, effort=effort
        )

    # End of each motion: the last time of its phase.
    times = dict(zip(bundle.trajectories[row].phase, bundle.trajectories[row].time, strict=True))
    stiffness = found.hand.stiffness[found.hand.dof[found.hand.joint_body]]
    press = stiffness * (postures["squeeze"].joint_positions[row] - postures["grasp"].joint_positions[row])
    closing, squeezing = times["close"] - times["shape"], times["squeeze"] - times["shape"]
    return {
        "id": bundle.grasp_name(row),
        "pre_grasp_posture": _joint_trajectory(bundle, names, [point("pregrasp", times["shape"] - times["approach"])]),
        "grasp_posture": _joint_trajectory(
            bundle, names, [point("grasp", closing), point("squeeze", squeezing, press[bundle.commanded_joints])]
        ),
        "grasp_pose": {
            "header": _header(bundle),
            "pose": _pose(bundle.tool_in_frame(postures["grasp"].hand_pose[row])),
        },
        "grasp_quality": rounded_numbers(found.quality["epsilon"][row])[0],
        "pre_grasp_approach": _translation(bundle, row, "standoff", "arrival"),
        "post_grasp_retreat": _translation(bundle, row, "squeeze", "lift"),
        "post_place_retreat": _translation(bundle, row, "arrival", "standoff"),
        "max_contact_force": 0.0,
        "allowed_touch_objects": [plain_name(found.obj.name)],
    }


def _header(bundle: Bundle) -> dict[str, Any]:
    return {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": bundle.frame}


def _pose(pose: Floats) -> dict[str, Any]:
    x, y, z, qw, qx, qy, qz = rounded_numbers(pose)
    return {"position": {"x": x, "y": y, "z": z}, "orientation": {"x": qx, "y": qy, "z": qz, "w": qw}}


def _translation(bundle: Bundle, row: int, start: str, end: str) -> dict[str, Any]:
    a, b = (bundle.tool_in_frame(bundle.found.postures[name].hand_pose[row])[:3] for name in (start, end))
    length = float(np.linalg.norm(b - a))
    x, y, z = rounded_numbers((b - a) / length)
    return {
        "direction": {"header": _header(bundle), "vector": {"x": x, "y": y, "z": z}},
        "desired_distance": round(length, 9),
        "min_distance": round(LEAST_SHARE * length, 9),
    }


def _joint_trajectory(bundle: Bundle, names: list[str], points: list[dict[str, Any]]) -> dict[str, Any]:
    return {"header": _header(bundle), "joint_names": names, "points": points}


def _trajectory_point(
    positions: Floats, seconds: float, velocities: Floats | None = None, effort: Floats | None = None
) -> dict[str, Any]:
    return {
        "positions": rounded_numbers(positions),
        "velocities": [] if velocities is None else rounded_numbers(velocities),
        "accelerations": [],
        "effort": [] if effort is None else rounded_numbers(effort),
        "time_from_start": _duration(seconds),
    }


def _duration(seconds: float) -> dict[str, int]:
    whole = round(seconds * 1e9)
    return {"sec": whole // 10**9, "nanosec": whole % 10**9}


def _trajectory(bundle: Bundle, path: RobotTrajectory) -> dict[str, Any]:
    """Return a RobotTrajectory with the joints, and with the tool frame's path as a floating joint."""
    kept = [k for k, name in enumerate(path.joint_names) if name not in bundle.description.mimics]
    names = [path.joint_names[k] for k in kept]
    points = [
        _trajectory_point(joints[kept], time, rate[kept])
        for joints, time, rate in zip(path.joints, path.time, path.velocity, strict=True)
    ]
    ways: list[dict[str, Any]] = []
    for pose, time in zip(map(_pose, bundle.tool_in_frame(path.hand_pose)), path.time, strict=True):
        transform = {"translation": pose["position"], "rotation": pose["orientation"]}
        empty: dict[str, list[float]] = {"velocities": [], "accelerations": []}
        ways.append({"transforms": [transform], **empty, "time_from_start": _duration(time)})
    floating = _joint_trajectory(bundle, [bundle.found.tool.name], ways)
    return {"joint_trajectory": _joint_trajectory(bundle, names, points), "multi_dof_joint_trajectory": floating}


def _write_hand(folder: Path, files: Mapping[str, bytes]) -> list[Path]:
    for name, data in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    return [folder / name for name in files]


def _write_object(bundle: Bundle, folder: Path) -> list[Path]:
    obj, name = bundle.found.obj, plain_name(bundle.found.obj.name)
    folder.mkdir(parents=True, exist_ok=True)
    urdf, mesh = folder / f"{name}.urdf", folder / f"{name}.obj"
    urdf.write_text(urdf_text(name, name, [mesh.name]))
    return [write_mesh(obj, mesh), urdf]
