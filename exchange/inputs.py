"""Grasps from files, for evaluation: base shards, published reference grasps, DexGraspBench folders."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graspd.exchange import dexgraspbench, published
from graspd.service.model.errors import InputError, NotFoundError
from graspd.service.store.shards import Shard, open_shard, read_shard, shard_kind
from graspd.worker.files.provenance import hand_of_shard, object_of_shard, scenes_of_shard
from graspd.worker.grasps import GraspSet
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.simulation.environment import PlacedGrasps

#: JSON files in folders of shards that contain no grasps.
BESIDE_SHARDS: Final = ("snapshot.json", "subset.json", "card.json", "clouds.json")


@dataclass(frozen=True)
class Case:
    """Grasps of one hand on one object."""

    name: str
    hand: HandModel
    obj: ObjectModel
    grasps: GraspSet
    friction: float | None = None  # coulomb coefficient of the file's metrics
    seconds: float | None = None  # time to make the grasps, if known [s]
    validated: bool = False  # whether `seconds` includes validation
    published: NDArray[np.int8] | None = None  # (N,) published success: 1 held, 0 failed, -1 unknown
    placed: PlacedGrasps | None = None

    @property
    def centred(self) -> Case:
        """The case in a frame at the object's centre, so that results do not depend on the mesh's origin."""
        return replace(
            self,
            obj=self.obj.centred,
            grasps=self.grasps.moved(np.negative(self.obj.centre)),
            placed=None if self.placed is None else self.placed.centred(self.obj),
        )


def expand_path(path: Path) -> list[Path]:
    """Return a path itself, or the base shards and reference grasps of a folder without `.npy` files.
    Raises InputError: the folder has no grasps."""
    if not path.is_dir() or any(path.rglob("*.npy")):
        return [path]
    shards = (file for file in path.rglob("*.h5") if not _is_scene_file(file))
    found = sorted([*shards, *(file for file in path.rglob("*.json") if file.name not in BESIDE_SHARDS)])
    if not found:
        raise InputError(f"{path} has no shards (.h5), reference grasps (.json) or DexGraspBench files (.npy)")
    return found


def _is_scene_file(path: Path) -> bool:
    """Check whether a file is a scene or views shard, which has no grasps of its own."""
    with open_shard(path) as file:
        return shard_kind(file, str(path)) != "base"


def load_case(path: Path, *, hand: str | None = None, obj: str | None = None) -> Case:
    """Read a base shard (HDF5), a reference-grasps JSON, or a folder with DexGraspBench `.npy` files.
    `hand` (URDF or built-in) and `obj` (mesh or built-in) replace hand and object of the file. Raises NotFoundError:
    the path does not exist; InputError: the file is invalid or of another hand."""
    if path.is_dir():
        return _load_bench_folder(path, hand, obj)
    if not path.is_file():
        raise NotFoundError(f"{path} does not exist")
    if path.suffix != ".json":
        shard = read_shard(path, kind="base")
        return case_of_shard(shard, hand_of_shard(shard, hand), object_of_shard(shard, obj))
    (found,) = published.read_reference(path, hand=hand, obj=obj)
    friction = published.stored_friction(path)
    return Case(path.name, found.hand, found.obj, found.grasps, friction=friction, published=found.published)


def case_of_shard(shard: Shard, model: HandModel, thing: ObjectModel) -> Case:
    """Return the grasps of a base shard that was read from a file.
    Raises InputError: the shard has another number of joints than the hand."""
    assert shard.path is not None
    grasps = GraspSet.from_columns(shard.arrays)
    if (joints := grasps.grasp.joint_positions.shape[1]) != len(model.joint_names):
        raise InputError(f"{shard.path} has {joints} joints, but {model.name} has {len(model.joint_names)}; plan again")
    said = shard.attributes
    return Case(
        shard.path.name,
        model,
        thing,
        grasps,
        friction=float(said["mu"]) if "mu" in said else None,  # type: ignore[arg-type]
        seconds=float(said["seconds"]) if "seconds" in said else None,  # type: ignore[arg-type]
        validated=said.get("verdict_level", "none") != "none",
        placed=scenes_of_shard(shard),
    )


def _load_bench_folder(path: Path, hand: str | None, obj: str | None) -> Case:
    if hand is None or obj is None:
        raise InputError("a DexGraspBench folder does not contain hand and object; name both: --hand and --object")
    sets = dexgraspbench.read(path, hand=hand, obj=obj)
    if len(sets) > 1:
        kinds = ", ".join(f"scale {one.scale:g}{' on a table' if one.placed else ''}" for one in sets)
        raise InputError(f"{path} has {len(sets)} kinds of grasps ({kinds}); give the folder of one")
    found = sets[0]
    return Case(path.name, found.hand, found.obj, found.grasps, published=found.published, placed=found.placed)
