"""Objects at the scale that a source gives its grasps for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from worker.objects.model import ObjectModel
from worker.objects.prepare import object_from_path


def scaled_object(path: str | Path, scale: float = 1.0) -> ObjectModel:
    """A mesh or built-in object, its size multiplied by `scale`.

    Sources that scale their meshes mean the numbers in the file, so no unit is guessed.

    Raises:
        NotFoundError, MeshError: see `object_from_path`.
    """
    if scale == 1.0:
        return object_from_path(path)
    plain = object_from_path(path, options={"units": "m"})
    extent = float(np.ptp(plain.vertices, axis=0).max())
    return object_from_path(path, options={"units": "m", "scale_to": extent * scale})


def mesh_file(obj: ObjectModel, path: Path) -> Path:
    """The object's prepared mesh as an OBJ file, for readers that have no other."""
    return write_obj(path, obj.vertices, obj.faces, f"{obj.name}, metres")


def write_obj(path: Path, vertices: Any, faces: Any, comment: str = "metres") -> Path:
    """Write a triangle mesh (V, 3), (F, 3) as an OBJ file."""
    lines = [f"# {comment}"]
    lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces]
    path.write_text("\n".join(lines) + "\n")
    return path
