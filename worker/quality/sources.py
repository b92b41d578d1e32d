"""Grasps to evaluate from files: our base shards, published reference grasps, DexGraspBench folders."""

from __future__ import annotations

import json
import pickle
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np
from numpy.typing import NDArray

from service.errors import InputError, NotFoundError
from service.shards import read_shard
from worker.grasps import GraspSet, Posture
from worker.hands.load import hand_from_path
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel
from worker.objects.prepare import object_from_path
from worker.quality.postures import pregrasp, squeeze
from worker.scenes.sources import hand_of_shard, object_of_shard
from worker.transforms import pose_from_matrix

Floats = NDArray[np.float64]

#: What a DexGraspBench file may name while it is unpickled: arrays, and nothing that runs.
_HARMLESS: Final = {
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("numpy.core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy.core.multiarray", "scalar"),
    ("numpy._core.multiarray", "scalar"),
}


@dataclass(frozen=True)
class Case:
    """Grasps of one hand on one object."""

    name: str
    hand: HandModel
    obj: ObjectModel
    grasps: GraspSet
    friction: float | None = None
    """Coulomb coefficient the file states for its metrics."""
    seconds: float | None = None
    """What making the grasps took, where it is known."""
    published: NDArray[np.int8] | None = None
    """(N,) success as published: 1, 0, -1 unknown."""


def load_case(path: Path, *, hand: str | None = None, obj: str | None = None) -> Case:
    """Read a file or folder of grasps.

    Args:
        path: a base shard (HDF5), a reference-grasps JSON, or a folder with DexGraspBench `.npy` files.
        hand: URDF or built-in hand, over what the file says.
        obj: mesh or built-in object, over what the file says.

    Raises:
        NotFoundError: no such file.
        InputError: not one of these formats, or it does not fit the hand.
    """
    if path.is_dir():
        return _bench_folder(path, hand, obj)
    if not path.is_file():
        raise NotFoundError(f"{path} does not exist")
    return _reference(path, hand, obj) if path.suffix == ".json" else _shard(path, hand, obj)


def _shard(path: Path, hand: str | None, obj: str | None) -> Case:
    shard = read_shard(path, kind="base")
    model, thing = hand_of_shard(shard, hand), object_of_shard(shard, obj)
    parts = {
        name: Posture(
            np.asarray(shard[f"{name}/hand_pose"], float), np.asarray(shard[f"{name}/joint_positions"], float)
        )
        for name in ("grasp", "pregrasp", "squeeze")
    }
    _check_joints(path, model, parts["grasp"])
    loss = np.asarray(shard["quality/stability_loss"], float)
    grasps = GraspSet(parts["grasp"], parts["pregrasp"], parts["squeeze"], loss)
    said = shard.attributes
    return Case(
        path.name, model, thing, grasps,
        friction=float(said["mu"]) if "mu" in said else None,  # type: ignore[arg-type]
        seconds=float(said["seconds"]) if "seconds" in said else None,  # type: ignore[arg-type]
    )  # fmt: skip


def _reference(path: Path, hand: str | None, obj: str | None) -> Case:
    try:
        stored: dict[str, Any] = json.loads(path.read_text())
        rows = stored["grasps"]
        root = path.resolve().parents[2]
        model = hand_from_path(hand or root / stored["hand"]["urdf"])
        thing = object_from_path(obj or root / "objects" / stored["object"] / "clean.stl")
        order = [stored["hand"]["joint_names"].index(name) for name in model.joint_names]
        pose = pose_from_matrix(np.array([row["T_object_base"] for row in rows], float))
        grasp = Posture(pose, np.array([row["q"] for row in rows], float)[:, order])
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise InputError(f"{path} is no file of reference grasps: {error!r}") from None
    published = np.array([_flag(row.get("pick_success_published")) for row in rows], np.int8)
    return Case(
        path.name, model, thing, _complete(model, thing, grasp),
        friction=stored.get("contact_model", {}).get("mu"), published=published,
    )  # fmt: skip


def _flag(value: object) -> int:
    return -1 if value is None else int(bool(value))


def _complete(hand: HandModel, obj: ObjectModel, grasp: Posture) -> GraspSet:
    """A grasp set with postures of ours before and after contact."""
    return GraspSet(grasp, pregrasp(hand, obj, grasp), squeeze(hand, obj, grasp), np.full(len(grasp), np.nan))


def _bench_folder(path: Path, hand: str | None, obj: str | None) -> Case:
    if hand is None or obj is None:
        raise InputError("a DexGraspBench folder does not hold the hand and the object; name both: --hand and --object")
    files = sorted(path.rglob("*.npy"))
    if not files:
        raise InputError(f"{path} has no .npy files; a DexGraspBench folder has one for each grasp")
    model, thing = hand_from_path(hand), object_from_path(obj)
    rows = [_bench_row(file) for file in files]
    parts = {}
    for name in ("grasp", "pregrasp", "squeeze"):
        qpos = np.array([np.asarray(row[f"{name}_qpos"], float) for row in rows])
        if qpos.ndim != 2 or qpos.shape[1] != 7 + len(model.joint_names):
            raise InputError(
                f"{path}: {name}_qpos has not 7 + {len(model.joint_names)} numbers; is --hand the right hand?"
            )
        parts[name] = Posture(qpos[:, :7], qpos[:, 7:])
    grasps = GraspSet(parts["grasp"], parts["pregrasp"], parts["squeeze"], np.full(len(rows), np.nan))
    return Case(path.name, model, thing, grasps)


def _bench_row(file: Path) -> dict[str, Any]:
    """The dictionary in a DexGraspBench file. Pickles run code, so only arrays are let through."""
    try:
        with file.open("rb") as stream:
            version = np.lib.format.read_magic(stream)
            reader = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            reader(stream)
            row = _Unpickler(stream).load()
        found = row.item() if isinstance(row, np.ndarray) else row
        missing = {"grasp_qpos", "pregrasp_qpos", "squeeze_qpos"} - set(found)
    except (ValueError, EOFError, TypeError, AttributeError, pickle.UnpicklingError) as error:
        raise InputError(f"{file} is no DexGraspBench grasp: {error}") from None
    if missing:
        raise InputError(f"{file} has no {sorted(missing)[0]}")
    return dict(found)


class _Unpickler(pickle.Unpickler):
    def __init__(self, stream: BinaryIO) -> None:
        super().__init__(stream)

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _HARMLESS:
            raise pickle.UnpicklingError(f"it would run {module}.{name}")
        return super().find_class(module, name)


def _check_joints(path: Path, hand: HandModel, grasp: Posture) -> None:
    if grasp.joint_positions.shape[1] != len(hand.joint_names):
        raise InputError(
            f"{path} has {grasp.joint_positions.shape[1]} joints, {hand.name} {len(hand.joint_names)}; give --hand"
        )
