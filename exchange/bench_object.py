"""Objects in DexGraspBench's layout: mesh, pieces, facts, scenes (afloat at scale 1, on a table)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Final

import numpy as np
import trimesh

from graspd.exchange.bench_scene import TABLETOP
from graspd.exchange.imported import mesh_file, write_obj
from graspd.service.model.transforms import IDENTITY_POSE, Floats
from graspd.worker.hands.primitives import hull, volume
from graspd.worker.objects.model import ObjectModel
from graspd.worker.validation.decomposition import decompose

#: Folder of a set of objects in a checkout of DexGraspBench.
SET: Final = Path("assets") / "object" / "graspd"
SCALE: Final = "scale100"


def write_object(obj: ObjectModel, name: str, root: Path) -> tuple[Path, Path]:
    """Write an object and its scene below `root`, laid out like a checkout of DexGraspBench.

    Returns:
        its folder and its scene's file, both relative to `root`.

    Raises:
        MeshError: its convex pieces do not match its shape.
    """
    folder, scene = SET / "processed_data" / name, SET / "scene_cfg" / name / "floating" / f"{SCALE}.npy"
    for part in (folder / "mesh", folder / "info", folder / "urdf" / "meshes", scene.parent, SET / "valid_split"):
        (root / part).mkdir(parents=True, exist_ok=True)
    mesh_file(obj, root / folder / "mesh" / "simplified.obj")
    pieces = [hull(corners) for corners in decompose(obj).vertices]
    meshes = root / folder / "urdf" / "meshes"
    # The evaluator reads every file of this folder as a piece: remove those of an earlier export.
    for old in meshes.iterdir():
        old.unlink()
    for number, (corners, faces) in enumerate(pieces):
        write_obj(meshes / f"convex_piece_{number:03}.obj", corners, faces)
    (root / folder / "urdf" / "coacd.urdf").write_text(_urdf(name, len(pieces)))
    solid = sum(volume("hull", (), corners, faces) for corners, faces in pieces)
    (root / folder / "info" / "simplified.json").write_text(json.dumps(_facts(obj, solid), indent=1) + "\n")
    _save(root / scene, _scene(name, f"floating/{SCALE}", IDENTITY_POSE))
    _add_to_split(root / SET / "valid_split" / "all.json", name)
    return folder, scene


def _facts(obj: ObjectModel, solid: float) -> dict[str, Any]:
    """Return facts with the scale of density: at density 1 the weighed pieces have this mass."""
    _, extents = trimesh.bounds.oriented_bounds(obj.hull_vertices)
    return {
        "gravity_center": obj.centre_of_mass.tolist(),
        "obb": np.asarray(extents, float).tolist(),
        "scale": 1.0,
        "density": 1.0,
        "mass": solid,
    }


def write_table(name: str, pose: Floats, number: int, root: Path) -> Path:
    """Write the scene of an exported object at `pose` (7,) on a table.

    Returns:
        the scene's file, relative to `root`.
    """
    place = f"{TABLETOP}/{SCALE}_pose{number:03}"
    file = SET / "scene_cfg" / name / f"{place}.npy"
    (root / file.parent).mkdir(parents=True, exist_ok=True)
    table = {"type": "plane", "pose": IDENTITY_POSE.copy(), "size": np.array([0.0, 0.0, 1.0])}
    scene = _scene(name, place, pose)
    scene["scene"]["table"] = table
    _save(root / file, scene)
    return file


def _save(file: Path, record: dict[str, Any]) -> None:
    np.save(file, np.array(record, dtype=object), allow_pickle=True)


def _scene(name: str, place: str, pose: Floats) -> dict[str, Any]:
    folder = f"../../../processed_data/{name}"
    thing = {
        "type": "rigid_object",
        "scale": np.ones(3),
        "pose": np.array(pose, float),
        "file_path": f"{folder}/mesh/simplified.obj",
        "info_path": f"{folder}/info/simplified.json",
        "urdf_path": f"{folder}/urdf/coacd.urdf",
    }
    return {"scene_id": f"{name}/{place}", "scene": {name: thing}, "task": {"type": "force_closure", "obj_name": name}}


def _urdf(name: str, pieces: int) -> str:
    lines = [f'<robot name="{name}">', '  <link name="object">']
    for number in range(pieces):
        mesh = f'<geometry><mesh filename="meshes/convex_piece_{number:03}.obj"/></geometry>'
        lines += [f"    <visual>{mesh}</visual>", f"    <collision>{mesh}</collision>"]
    return "\n".join([*lines, "  </link>", "</robot>", ""])


def _add_to_split(file: Path, name: str) -> None:
    names = json.loads(file.read_text()) if file.is_file() else []
    file.write_text(json.dumps(sorted({*names, name}), indent=1) + "\n")
