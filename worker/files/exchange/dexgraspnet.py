"""DexGraspNet's layout: a `.npy` for each object, a list of dictionaries with `qpos` by joint name and `scale`.

Wang et al., DexGraspNet, ICRA 2023. `qpos` has the root's translation WRJTx, y, z [m], its rotation WRJRx, y, z (Euler
angles about the fixed axes x, y, z in turn [rad]), and the joints `robot0:FFJ3` ... of the MuJoCo Shadow hand, whose
numbers are one less than those of the URDF (FFJ4 ...). The object's mesh is multiplied by `scale`.
"""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any, Final

import numpy as np

from service.model.errors import InputError
from service.model.transforms import compose, quat_from_axis_angle, quat_multiply
from worker.files.exchange.imported import Imported, completed, joints_by_name
from worker.files.exchange.objects import scaled_object
from worker.files.exchange.pickles import load_npy
from worker.grasps import Posture
from worker.hands.load import hand_from_path
from worker.hands.model import HandModel

_TRANSLATION: Final = ("WRJTx", "WRJTy", "WRJTz")
_ROTATION: Final = ("WRJRx", "WRJRy", "WRJRz")
_MUJOCO: Final = "robot0:"


def read(path: Path, *, hand: str, obj: str, root_offset: np.ndarray | None = None) -> list[Imported]:
    """Grasps of one object, a set for each scale.

    Args:
        path: the object's `.npy`.
        hand: URDF or built-in hand.
        obj: the object's mesh at scale 1.
        root_offset: (7,) pose of the hand's root link in the frame that the source calls the root; by default they
            are one frame.

    Raises:
        InputError: not such a file, or its joints are not the hand's.
    """
    found = load_npy(path)
    rows = list(found) if isinstance(found, list | np.ndarray) else []
    if not rows or not all(isinstance(row, dict) and "qpos" in row for row in rows):
        raise InputError(f"{path} is no list of grasps with `qpos`, as DexGraspNet has it")
    by_scale: dict[float, list[dict[str, Any]]] = defaultdict(list)
    for row in rows:
        by_scale[float(row.get("scale", 1.0))].append(row)
    model = hand_from_path(hand)
    sets = []
    for scale, some in sorted(by_scale.items()):
        thing = scaled_object(obj, scale)
        grasps = completed(model, thing, _grasp(path, model, some, root_offset))
        sets.append(Imported(model, thing, grasps, path.stem, scale))
    return sets


def _grasp(path: Path, hand: HandModel, rows: list[dict[str, Any]], root_offset: Any) -> Posture:
    try:
        place = np.array([[row["qpos"][name] for name in _TRANSLATION] for row in rows], float)
        angles = np.array([[row["qpos"][name] for name in _ROTATION] for row in rows], float)
        names = [name for name in rows[0]["qpos"] if name not in (*_TRANSLATION, *_ROTATION)]
        values = np.array([[row["qpos"][name] for name in names] for row in rows], float)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: a grasp has no {error}") from None
    turns = [quat_from_axis_angle(axis, angles[:, k]) for k, axis in enumerate(np.eye(3))]
    pose = np.concatenate([place, quat_multiply(turns[2], quat_multiply(turns[1], turns[0]))], axis=1)
    if root_offset is not None:
        pose = compose(pose, np.asarray(root_offset, float))
    return Posture(pose, joints_by_name(hand, [_urdf_name(name, hand) for name in names], values, what=str(path)))


def _urdf_name(name: str, hand: HandModel) -> str:
    """`robot0:FFJ3` is FFJ4 of the URDF, perhaps behind a prefix such as `rh_`; other names stand as they are."""
    if not name.startswith(_MUJOCO):
        return name
    plain = name.removeprefix(_MUJOCO)
    urdf = f"{plain[:-1]}{int(plain[-1]) + 1}"
    return next((joint for joint in hand.joint_names if joint == urdf or joint.endswith(f"_{urdf}")), urdf)
