"""MultiDex, the dataset of GenDexGrasp: a torch file with a list `metadata` of (..., q, object, robot) tuples.

Li et al., GenDexGrasp, ICRA 2023. `q` has the root's translation [m], the first two columns of its rotation matrix,
and the joints in the order of the robot's URDF. The original entries begin with a contact map; later versions of the
file leave it out, and some give the rotation as three Euler angles (rotating axes x, y, z).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from service.model.errors import InputError
from service.model.transforms import Floats, quat_from_axis_angle, quat_from_matrix, quat_multiply
from worker.files.exchange.imported import Imported, completed
from worker.files.exchange.objects import scaled_object
from worker.grasps import Posture
from worker.hands.load import hand_from_path


def read(path: Path, *, hand: str, obj: str, robot: str, object_name: str) -> list[Imported]:
    """The grasps of one robot on one object.

    Args:
        path: `cmap_dataset.pt`. Read by torch with nothing but tensors and plain values let through.
        hand: URDF or built-in hand: the robot.
        obj: mesh of the object.
        robot: the robot's name in the file, `allegro` say.
        object_name: the object's name in the file, `contactdb+mug` say.

    Raises:
        InputError: torch is missing, not such a file, or nothing of that robot and object in it.
    """
    rows = [row for row in _metadata(path) if len(row) >= 3 and row[-1] == robot and row[-2] == object_name]
    if not rows:
        raise InputError(f"{path} has no grasp of {robot!r} on {object_name!r}")
    model, thing = hand_from_path(hand), scaled_object(obj)
    q = np.stack([np.asarray(row[-3], float).ravel() for row in rows])
    joints = len(model.joint_names)
    if q.shape[1] not in (9 + joints, 6 + joints):
        raise InputError(f"{path}: q has {q.shape[1]} numbers, {model.name} needs 9 + {joints} or 6 + {joints}")
    turn = rotation_of_columns(q[:, 3:9]) if q.shape[1] == 9 + joints else rotation_of_angles(q[:, 3:6])
    grasp = Posture(np.concatenate([q[:, :3], turn], axis=1), q[:, -joints:])
    return [Imported(model, thing, completed(model, thing, grasp), object_name.rpartition("+")[2])]


def rotation_of_columns(columns: Floats) -> Floats:
    """(N, 4) quaternion of rotations given by their first two columns (N, 6), made orthogonal evenly."""
    x, y = (_unit(part) for part in (columns[:, :3], columns[:, 3:]))
    middle, across = _unit(x + y), _unit(x - y)
    x, y = _unit(middle + across), _unit(middle - across)
    return quat_from_matrix(np.stack([x, y, _unit(np.cross(x, y))], axis=-1))


def rotation_of_angles(angles: Floats) -> Floats:
    """(N, 4) quaternion of rotations about the rotating axes x, y, z in turn (N, 3) [rad]."""
    x, y, z = (quat_from_axis_angle(axis, angles[:, k]) for k, axis in enumerate(np.eye(3)))
    return quat_multiply(x, quat_multiply(y, z))


def _unit(vectors: Floats) -> Floats:
    unit: Floats = vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)
    return unit


def _metadata(path: Path) -> list[Any]:
    try:
        import torch
    except ModuleNotFoundError:
        raise InputError(f"{path} is a torch file; `pip install torch` to read it") from None
    try:
        found = torch.load(path, map_location="cpu", weights_only=True)
        return list(found["metadata"])
    except Exception as error:
        # torch raises what its readers happen to raise; all of it means that the file is not what it should be.
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise InputError(f"{path} is no MultiDex file that can be read safely: {reason}") from None
