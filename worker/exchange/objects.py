"""Objects at the scale that a source gives its grasps for."""

from __future__ import annotations

from pathlib import Path

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
    lines = [f"# {obj.name}, metres"]
    lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in obj.vertices]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in obj.faces]
    path.write_text("\n".join(lines) + "\n")
    return path
