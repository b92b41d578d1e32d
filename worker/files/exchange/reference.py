"""Reference grasps as JSON (`reference-grasps/1`): poses as matrices, joints by name, published scores beside them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from pydantic_core import from_json

from service.model.base import why
from service.model.errors import InputError
from service.model.transforms import pose_from_matrix
from worker.files.exchange.imported import Imported, completed, joints_by_name
from worker.files.exchange.objects import scaled_object
from worker.grasps import Posture
from worker.hands.load import hand_from_path


def read(path: Path, *, hand: str | None = None, obj: str | None = None) -> list[Imported]:
    """The grasps of one file; hand and object by default those beside it that the file names.

    Raises:
        InputError: not such a file.
    """
    stored = _stored(path)
    try:
        rows = stored["grasps"]
        # The set's root has hands/, objects/ and reference_grasps/ in it.
        root = path.resolve().parents[2]
        model = hand_from_path(hand or root / stored["hand"]["urdf"])
        thing = scaled_object(obj or root / "objects" / stored["object"] / "clean.stl")
        pose = pose_from_matrix(np.array([row["T_object_base"] for row in rows], float))
        values = np.array([row["q"] for row in rows], float)
        joints = joints_by_name(model, stored["hand"]["joint_names"], values, what=str(path))
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise InputError(f"{path} is no file of reference grasps: {error!r}") from None
    published = np.array([_flag(row.get("pick_success_published")) for row in rows], np.int8)
    grasps = completed(model, thing, Posture(pose, joints))
    return [Imported(model, thing, grasps, str(stored["object"]), published=published)]


def friction(path: Path) -> float | None:
    """Coulomb coefficient that the file states for its metrics."""
    value = _stored(path).get("contact_model", {}).get("mu")
    return None if value is None else float(value)


def _stored(path: Path) -> dict[str, Any]:
    try:
        found = from_json(path.read_bytes())
    except (OSError, ValueError) as error:
        raise InputError(f"{path} is no JSON file: {why(error)}") from None
    if not isinstance(found, dict):
        raise InputError(f"{path} is no file of reference grasps: it holds no object")
    return found


def _flag(value: object) -> int:
    return -1 if value is None else int(bool(value))
