"""Readers of published grasp sets: DDGC, DexGraspNet, MultiDex (GenDexGrasp), `reference-grasps/1`.

DDGC (Lundell et al., RA-L 2021): a list of grasps per object. A grasp has position and quaternion x y z w of the hand
in the object's frame, and eight joint angles, positive towards closing, in the order of `ROLES`.

DexGraspNet (Wang et al., ICRA 2023): a `.npy` file per object with a list of dictionaries. `scale` multiplies the mesh.
`qpos` has the root's translation WRJTx, y, z [m] and its rotation WRJRx, y, z: Euler angles about the fixed axes x, y,
z in turn [rad]. Joints are `robot0:FFJ3` ... of the MuJoCo Shadow hand, with numbers one less than in the URDF.

MultiDex (Li et al., GenDexGrasp, ICRA 2023): a torch file with a list `metadata` of tuples (..., q, object, robot). `q`
has the root's translation [m], the first two columns of its rotation matrix, and the joints in the order of the robot's
URDF. Some versions of the file have three Euler angles (rotating axes x, y, z) instead of columns.

Reference grasps (`reference-grasps/1`): JSON with poses as matrices, joints by name, and published scores."""

import re
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
from graspd.service.model.transforms import (
    Floats,
    pose_from_matrix,
    quat_from_axis_angle,
    quat_from_matrix,
    quat_multiply,
)
from graspd.worker.grasps import Posture
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel

#: Patterns of joint names, in the file's order: spread, medial and distal of finger 1 and 2, medial and distal of 3.
ROLES: Final = tuple(
    rf"(?=.*{finger}).*({words})|j{finger}{number}"
    for finger, phalanges in (("1", "smd"), ("2", "smd"), ("3", "md"))
    for words, number in ({"s": ("prox|spread", 1), "m": ("med", 2), "d": ("dist", 3)}[part] for part in phalanges)
)


def read_ddgc(path: Path, *, hand: str, obj: str, number: int = 0) -> list[ImportedGrasps]:
    """Read grasps on object `number` of `barrett_translation_K.npy` and `barrett_representation_K.npy`.
    Raises InputError, like all readers here: files are invalid, or hand or object do not fit."""
    beside = path.with_name(path.name.replace("translation", "representation"))
    if beside == path or not beside.is_file():
        raise InputError(f"{path} needs its barrett_representation_K.npy in the same folder")
    places, joints = (list(load_npy(file)) for file in (path, beside))
    if number >= len(places) or len(places) != len(joints):
        raise InputError(
            f"{path} has {len(places)} objects and {beside.name} {len(joints)}; object {number} was requested"
        )
    place, values = np.asarray(places[number], float), np.asarray(joints[number], float)
    if place.ndim != 2 or place.shape[1] != 7 or values.shape != (len(place), len(ROLES)):
        raise InputError(f"{path}: object {number} has grasps of shape {place.shape} and joints of {values.shape}")
    model, thing = hand_from_path(hand), scaled_object(obj)
    pose = np.concatenate([place[:, :3], place[:, 6:], place[:, 3:6]], axis=1)
    names = []
    for role in ROLES:
        found = [name for name in model.joint_names if re.search(role, name)]
        if len(found) != 1:
            raise InputError(f"{model.name} is no Barrett hand: not exactly one joint matches {role!r}")
        names.append(found[0])
    grasp = Posture(pose, joints_by_name(model, names, values * _closing_signs(model, names), what=str(path)))
    return [ImportedGrasps(model, thing, add_postures(model, thing, grasp), thing.name)]


def _closing_signs(hand: HandModel, names: list[str]) -> Floats:
    """Return the sign of each joint's closing: -1 if it closes towards negative angles, else 1."""
    order = [hand.joint_names.index(name) for name in names]
    ends = np.array([hand.expand(limit[None])[0][order] for limit in (hand.lower, hand.upper)])
    return np.where(ends.max(axis=0) > -ends.min(axis=0), 1.0, -1.0)


_TRANSLATION: Final = ("WRJTx", "WRJTy", "WRJTz")
_ROTATION: Final = ("WRJRx", "WRJRy", "WRJRz")
_MUJOCO: Final = "robot0:"


def read_dexgraspnet(path: Path, *, hand: str, obj: str) -> list[ImportedGrasps]:
    """Read an object's `.npy` file into one set of grasps for each scale."""
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


def read_multidex(path: Path, *, hand: str, obj: str, robot: str, object_name: str) -> list[ImportedGrasps]:
    """Read the grasps of one robot (`allegro`) on one object (`contactdb+mug`) in `cmap_dataset.pt`."""
    rows = [row for row in _metadata(path) if len(row) >= 3 and row[-1] == robot and row[-2] == object_name]
    if not rows:
        raise InputError(f"{path} has no grasp of {robot!r} on {object_name!r}")
    model, thing = hand_from_path(hand), scaled_object(obj)
    q = np.stack([np.asarray(row[-3], float).ravel() for row in rows])
    joints = len(model.joint_names)
    if q.shape[1] not in (9 + joints, 6 + joints):
        raise InputError(f"{path}: q has {q.shape[1]} numbers, but {model.name} needs 9 + {joints} or 6 + {joints}")
    turn = rotation_of_columns(q[:, 3:9]) if q.shape[1] == 9 + joints else rotation_of_angles(q[:, 3:6])
    grasp = Posture(np.concatenate([q[:, :3], turn], axis=1), q[:, -joints:])
    return [ImportedGrasps(model, thing, add_postures(model, thing, grasp), object_name.rpartition("+")[2])]


def rotation_of_columns(columns: Floats) -> Floats:
    """Return quaternions (N, 4) of rotations from two columns (N, 6); both turn equally to be orthogonal."""
    x, y = (_unit(part) for part in (columns[:, :3], columns[:, 3:]))
    middle, across = _unit(x + y), _unit(x - y)
    x, y = _unit(middle + across), _unit(middle - across)
    return quat_from_matrix(np.stack([x, y, _unit(np.cross(x, y))], axis=-1))


def rotation_of_angles(angles: Floats) -> Floats:
    """Return quaternions (N, 4) of rotations about the rotating axes x, y, z (N, 3) [rad]."""
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
        # torch raises arbitrary exceptions; all of them mean an invalid file.
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise InputError(f"{path} is no MultiDex file that can be read safely: {reason}") from None


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
