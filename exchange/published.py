"""Readers of published grasp sets: DexGraspNet and `reference-grasps/1`.

DexGraspNet (Wang et al., ICRA 2023): a `.npy` file per object with a list of dictionaries. `scale` multiplies the mesh.
`qpos` has the root's translation WRJTx, y, z [m] and its rotation WRJRx, y, z: Euler angles about the fixed axes x, y,
z in turn [rad]. Joints are `robot0:FFJ3` ... of the MuJoCo Shadow hand, with numbers one less than in the URDF.

Reference grasps (`reference-grasps/1`): JSON with poses as matrices, joints by name, and published scores."""

from collections import defaultdict
from pathlib import Path
from typing import Any, Final

import numpy as np
from pydantic_core import from_json

from graspd.exchange.imported import (
    ImportedGrasps,
    add_postures,
    joints_by_name,
    load_npy,
    parse_verdicts,
    scaled_object,
)
from graspd.service.model.base import error_text
from graspd.service.model.errors import InputError
from graspd.service.model.transforms import pose_from_matrix, quat_from_axis_angle, quat_multiply
from graspd.worker.grasps import Posture
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel

_TRANSLATION: Final = ("WRJTx", "WRJTy", "WRJTz")
_ROTATION: Final = ("WRJRx", "WRJRy", "WRJRz")
_MUJOCO: Final = "robot0:"


def read_dexgraspnet(path: Path, *, hand: str, obj: str) -> list[ImportedGrasps]:
    """Read an object's `.npy` file into one set of grasps for each scale.
    Raises InputError, like all readers here: files are invalid, or hand or object do not fit."""
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
        grasps = add_postures(model, thing, _read_postures(path, model, some))
        sets.append(ImportedGrasps(model, thing, grasps, path.stem, scale))
    return sets


def _read_postures(path: Path, hand: HandModel, rows: list[dict[str, Any]]) -> Posture:
    try:
        place = np.array([[row["qpos"][name] for name in _TRANSLATION] for row in rows], float)
        angles = np.array([[row["qpos"][name] for name in _ROTATION] for row in rows], float)
        names = [name for name in rows[0]["qpos"] if name not in (*_TRANSLATION, *_ROTATION)]
        values = np.array([[row["qpos"][name] for name in names] for row in rows], float)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: a grasp has no {error}") from None
    turns = [quat_from_axis_angle(axis, angles[:, k]) for k, axis in enumerate(np.eye(3))]
    pose = np.concatenate([place, quat_multiply(turns[2], quat_multiply(turns[1], turns[0]))], axis=1)
    return Posture(pose, joints_by_name(hand, [_urdf_name(name, hand) for name in names], values, what=str(path)))


def _urdf_name(name: str, hand: HandModel) -> str:
    """Return the URDF's name, FFJ4 or with a prefix rh_FFJ4, of a joint `robot0:FFJ3`; keep other names."""
    if not name.startswith(_MUJOCO):
        return name
    plain = name.removeprefix(_MUJOCO)
    urdf = f"{plain[:-1]}{int(plain[-1]) + 1}"
    return next((joint for joint in hand.joint_names if joint == urdf or joint.endswith(f"_{urdf}")), urdf)


def read_reference(path: Path, *, hand: str | None = None, obj: str | None = None) -> list[ImportedGrasps]:
    """Read the grasps of one file; hand and object default to the names in the file."""
    stored = _read_json_object(path)
    try:
        rows = stored["grasps"]
        # The set's root contains hands/, objects/ and reference_grasps/.
        root = path.resolve().parents[2]
        model = hand_from_path(hand or root / stored["hand"]["urdf"])
        thing = scaled_object(obj or root / "objects" / stored["object"] / "clean.stl")
        pose = pose_from_matrix(np.array([row["T_object_base"] for row in rows], float))
        values = np.array([row["q"] for row in rows], float)
        joints = joints_by_name(model, stored["hand"]["joint_names"], values, what=str(path))
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise InputError(f"{path} is no file of reference grasps: {error!r}") from None
    published = parse_verdicts([row.get("pick_success_published") for row in rows])
    grasps = add_postures(model, thing, Posture(pose, joints))
    return [ImportedGrasps(model, thing, grasps, str(stored["object"]), published=published)]


def stored_friction(path: Path) -> float | None:
    """Return the Coulomb coefficient of the file's metrics; None if it is not stated."""
    value = _read_json_object(path).get("contact_model", {}).get("mu")
    return None if value is None else float(value)


def _read_json_object(path: Path) -> dict[str, Any]:
    try:
        found = from_json(path.read_bytes())
    except (OSError, ValueError) as error:
        raise InputError(f"{path} is no JSON file: {error_text(error)}") from None
    if not isinstance(found, dict):
        raise InputError(f"{path} is no file of reference grasps: it is no JSON object")
    return found
