"""Imported grasps before validation: scaled objects, and safe reading of NumPy pickles.

A pickle can call any function while it is loaded; this module allows only arrays, numbers, strings and containers."""

import pickle
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.base import error_text
from graspd.service.model.errors import InputError
from graspd.service.model.transforms import Floats
from graspd.worker.control.postures import pregrasp, squeeze
from graspd.worker.grasps import GraspSet, Posture
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.simulation.environment import PlacedGrasps


@dataclass(frozen=True)
class Origin:
    """Source of grasps, and their licence."""

    format: str
    source: str  # reference: an address or a citation
    licence: str


@dataclass(frozen=True)
class ImportedGrasps:
    """Grasps of one hand on one object, each with its three postures."""

    hand: HandModel
    obj: ObjectModel
    grasps: GraspSet
    name: str  # name of the object in the source
    scale: float = 1.0  # scale factor of the object's mesh
    published: NDArray[np.int8] | None = None  # (N,) published success: 1 held, 0 failed, -1 unknown
    placed: PlacedGrasps | None = None


def add_postures(hand: HandModel, obj: ObjectModel, grasp: Posture) -> GraspSet:
    """Add pregrasp and squeeze, as graspd computes them, to grasps of a source that lacks both."""
    return GraspSet(grasp, pregrasp(hand, obj, grasp), squeeze(hand, obj, grasp), np.full(len(grasp), np.nan))


def parse_verdicts(values: Sequence[Any] | NDArray[Any]) -> NDArray[np.int8]:
    """Return (N,) verdicts of a file: 1 held, 0 dropped, -1 unknown."""
    return np.array([int(value) if value in (0, 1) else -1 for value in np.ravel(values).tolist()], np.int8)


def joints_by_name(hand: HandModel, names: Sequence[str], values: Any, *, what: str) -> Floats:
    """Return (N, J) joints of the hand from (N, n) values of `names`; other joints are at mid-range.
    Raises InputError, beginning with `what`: the numbers differ, or the hand has no such joint."""
    given = np.atleast_2d(np.asarray(values, float))
    if given.shape[1] != len(names):
        raise InputError(f"{what}: {given.shape[1]} joint values for {len(names)} joints")
    if unknown := [name for name in names if name not in hand.joint_names]:
        raise InputError(f"{what}: {hand.name} has no joint {unknown[0]!r}; it has {', '.join(hand.joint_names)}")
    order = [hand.joint_names.index(name) for name in names]
    middle = hand.expand(0.5 * (hand.lower + hand.upper)[None])[0]
    out = np.tile(middle, (len(given), 1))
    out[:, order] = given
    return out


def scaled_object(path: str | Path, scale: float = 1.0) -> ObjectModel:
    """Load a mesh or built-in object, scaled. Unless `scale` is 1, the mesh must be in metres."""
    if scale == 1.0:
        return object_from_path(path)
    plain = object_from_path(path, options={"units": "m"})
    extent = float(np.ptp(plain.vertices, axis=0).max())
    return object_from_path(path, options={"units": "m", "scale_to": extent * scale})


def write_mesh(obj: ObjectModel, path: Path) -> Path:
    """Write the object's prepared mesh as an OBJ file, which all readers support."""
    return write_obj(path, obj.vertices, obj.faces, f"{obj.name}, metres")


def write_obj(path: Path, vertices: Any, faces: Any, comment: str = "metres") -> Path:
    """Write a triangle mesh (V, 3), (F, 3) as an OBJ file."""
    lines = [f"# {comment}"]
    lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces]
    path.write_text("\n".join(lines) + "\n")
    return path


def urdf_text(name: str, link: str, meshes: Sequence[str]) -> str:
    """Return the URDF of one link made of meshes."""
    lines = [f'<robot name="{name}">', f'  <link name="{link}">']
    for mesh in meshes:
        geometry = f'<geometry><mesh filename="{mesh}"/></geometry>'
        lines += [f"    <visual>{geometry}</visual>", f"    <collision>{geometry}</collision>"]
    return "\n".join([*lines, "  </link>", "</robot>", ""])


_HARMLESS: Final = {
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("numpy.core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy.core.multiarray", "scalar"),
    ("numpy._core.multiarray", "scalar"),
    ("numpy.core.numeric", "_frombuffer"),
    ("numpy._core.numeric", "_frombuffer"),
}


class _SafeUnpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _HARMLESS:
            raise pickle.UnpicklingError(f"it would run {module}.{name}")
        return super().find_class(module, name)


def load_npy(path: Path) -> Any:
    """Load a `.npy` file: an array, or its only object.
    Raises InputError: the file is invalid, or would run code."""
    try:
        with path.open("rb") as file:
            try:
                return np.lib.format.read_array(file, allow_pickle=False)
            except ValueError as error:
                if "Object arrays" not in str(error):
                    raise
            # The stream is now after the header, at the pickle.
            found = _SafeUnpickler(file).load()
    except pickle.UnpicklingError as error:
        raise InputError(f"{path} cannot be read safely: {error}") from None
    except Exception as error:  # an untrusted pickle may raise anything
        raise InputError(f"{path} is no NumPy file: {error_text(error)}") from None
    return found.item() if isinstance(found, np.ndarray) and found.shape == () else found
