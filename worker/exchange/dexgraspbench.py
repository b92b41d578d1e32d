"""DexGraspBench's layout: one pickled dictionary a grasp, `graspdata/<object>/<scale and pose>/<number>.npy`.

Fields: `obj_path`, `obj_scale`, `obj_pose` (7,), and `pregrasp_qpos`, `grasp_qpos`, `squeeze_qpos` (7 + J,) each: root
position, root quaternion w x y z, joints. Root and object stand in one world frame. The hand's root is that of the
model which a benchmark's configuration names: read with the URDF that the grasps were written with.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from service.errors import InputError
from service.transforms import IDENTITY_POSE, compose, invert
from worker.exchange.imported import Imported
from worker.exchange.objects import mesh_file, scaled_object
from worker.exchange.pickles import load_npy
from worker.grasps import GraspSet, Posture
from worker.hands.load import hand_from_path
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel

Floats = NDArray[np.float64]

POSTURES: Final = ("pregrasp", "grasp", "squeeze")
_FOLDER: Final = "graspdata"


def read(path: Path, *, hand: str, obj: str) -> list[Imported]:
    """Grasps of one hand on one object, a set for each scale of the object.

    Args:
        path: a file, or a folder searched whole.
        hand: URDF or built-in hand whose root and order of joints the files have.
        obj: mesh or built-in object at scale 1.

    Raises:
        InputError: no such files, or they do not fit the hand.
    """
    files = [path] if path.is_file() else sorted(path.rglob("*.npy"))
    if not files:
        raise InputError(f"{path} has no .npy files; DexGraspBench has one for each grasp")
    by_scale: dict[float, list[dict[str, Any]]] = defaultdict(list)
    for file in files:
        row = _row(file)
        by_scale[_scale(row)].append(row)
    model = hand_from_path(hand)
    return [_set(path, model, scaled_object(obj, scale), rows, scale) for scale, rows in sorted(by_scale.items())]


def write(hand: HandModel, obj: ObjectModel, grasps: GraspSet, rows: Sequence[int], folder: Path) -> list[Path]:
    """Write grasps in this layout, the object at scale 1 in the origin, with its mesh and a note on the hand's root.

    Returns:
        the files, one for each grasp.
    """
    out = folder / _FOLDER / obj.name / "scale100_pose000"
    out.mkdir(parents=True, exist_ok=True)
    meshes = folder / "assets" / "object" / obj.name
    meshes.mkdir(parents=True, exist_ok=True)
    mesh = mesh_file(obj, meshes / "mesh.obj")
    note = {
        "hand": hand.name, "root_link": hand.root_link, "joint_names": list(hand.joint_names), "unit": "m, rad",
        "quaternion": "w x y z", "object_frame": "mesh.obj",
    }  # fmt: skip
    (folder / f"hand_{hand.name}.json").write_text(json.dumps(note, indent=1) + "\n")
    paths = []
    for row in rows:
        record: dict[str, Any] = {
            "obj_path": str(mesh.parent.relative_to(folder)), "obj_scale": 1.0, "obj_pose": IDENTITY_POSE.copy(),
        }  # fmt: skip
        for name in POSTURES:
            posture: Posture = getattr(grasps, name)
            record[f"{name}_qpos"] = np.concatenate([posture.hand_pose[row], posture.joint_positions[row]])
        path = out / f"{row}.npy"
        np.save(path, np.array(record, dtype=object), allow_pickle=True)
        paths.append(path)
    return paths


def _row(file: Path) -> dict[str, Any]:
    found = load_npy(file)
    if not isinstance(found, dict):
        raise InputError(f"{file} holds no dictionary; DexGraspBench has one a file")
    if missing := [f"{name}_qpos" for name in POSTURES if f"{name}_qpos" not in found]:
        raise InputError(f"{file} has no {missing[0]}")
    return found


def _scale(row: dict[str, Any]) -> float:
    return float(np.ravel(row.get("obj_scale", 1.0))[0])


def _set(path: Path, hand: HandModel, obj: ObjectModel, rows: list[dict[str, Any]], scale: float) -> Imported:
    pose = np.array([np.ravel(row.get("obj_pose", IDENTITY_POSE)) for row in rows], float)
    parts = {name: _posture(path, hand, name, rows, pose) for name in POSTURES}
    grasps = GraspSet(parts["grasp"], parts["pregrasp"], parts["squeeze"], np.full(len(rows), np.nan))
    published = np.array([int(bool(row["succ_flag"])) if "succ_flag" in row else -1 for row in rows], np.int8)
    name = str(rows[0].get("obj_path", obj.name)).rstrip("/").rsplit("/", 1)[-1]
    return Imported(hand, obj, grasps, name, scale, published)


def _posture(path: Path, hand: HandModel, name: str, rows: list[dict[str, Any]], obj_pose: Floats) -> Posture:
    try:
        qpos = np.array([np.ravel(row[f"{name}_qpos"]) for row in rows], float)
    except ValueError as error:
        raise InputError(f"{path}: {name}_qpos has not one length in all files: {error}") from None
    if qpos.shape[1] != 7 + len(hand.joint_names):
        raise InputError(
            f"{path}: {name}_qpos has {qpos.shape[1]} numbers, {hand.name} needs 7 + {len(hand.joint_names)}; "
            "is --hand the right hand?"
        )
    return Posture(compose(invert(obj_pose), qpos[:, :7]), qpos[:, 7:])
