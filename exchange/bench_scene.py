"""Objects and scenes in DexGraspBench's layout, and grasps on a table in its tabletop test's format.

Files of an object are its mesh, convex pieces, measurements, and scenes. In a scene the object floats at scale 1 or is
on a table. Poses on a table are in the table's frame: z up, top at z = 0, where the evaluator has a floor."""

import json
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any, Final

import numpy as np
import trimesh

from graspd.exchange.bench_hand import HandMapping
from graspd.exchange.imported import load_npy, urdf_text, write_mesh, write_obj
from graspd.service.model.errors import InputError
from graspd.service.model.scene_spec import SceneSpec
from graspd.service.model.transforms import IDENTITY_POSE, Floats, compose, invert
from graspd.worker.grasps import GraspSet, Posture
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.primitives import hull, volume
from graspd.worker.objects.model import ObjectModel
from graspd.worker.scenes.kinds import supports_of
from graspd.worker.simulation.environment import PlacedGrasps
from graspd.worker.validation.decomposition import decompose

Row = dict[str, Any]

TABLETOP: Final = "tabletop"  # folder of scenes with a table, and part of the names of their experiments
SAME: Final = 1e-9  # tolerance of equal positions and of the table's height [m], and of equal quaternions
#: Folder of a set of objects in a checkout of DexGraspBench.
SET: Final = Path("assets") / "object" / "graspd"
SCALE: Final = "scale100"


def write_object(obj: ObjectModel, name: str, root: Path) -> tuple[Path, Path]:
    """Write an object and its scene below `root`; return its folder and scene file, relative to `root`."""
    folder, scene = SET / "processed_data" / name, SET / "scene_cfg" / name / "floating" / f"{SCALE}.npy"
    for part in (folder / "mesh", folder / "info", folder / "urdf" / "meshes", SET / "valid_split"):
        (root / part).mkdir(parents=True, exist_ok=True)
    write_mesh(obj, root / folder / "mesh" / "simplified.obj")
    pieces = [hull(corners) for corners in decompose(obj).vertices]
    meshes = root / folder / "urdf" / "meshes"
    # The evaluator reads all files of this folder as pieces, so those of an earlier export are removed.
    for old in meshes.iterdir():
        old.unlink()
    written = [write_obj(meshes / f"convex_piece_{k:03}.obj", *piece) for k, piece in enumerate(pieces)]
    urdf = urdf_text(name, "object", [f"meshes/{file.name}" for file in written])
    (root / folder / "urdf" / "coacd.urdf").write_text(urdf)
    _, extents = trimesh.bounds.oriented_bounds(obj.hull_vertices)
    facts: Row = {"gravity_center": obj.centre_of_mass.tolist(), "obb": np.asarray(extents, float).tolist()}
    mass = sum(volume("hull", (), corners, faces) for corners, faces in pieces)
    facts |= {"scale": 1.0, "density": 1.0, "mass": mass}
    (root / folder / "info" / "simplified.json").write_text(json.dumps(facts, indent=1) + "\n")
    save_record(root / scene, _scene_configuration(name, f"floating/{SCALE}", IDENTITY_POSE))
    split = root / SET / "valid_split" / "all.json"
    names = json.loads(split.read_text()) if split.is_file() else []
    split.write_text(json.dumps(sorted({*names, name}), indent=1) + "\n")
    return folder, scene


def write_table(name: str, pose: Floats, number: int, root: Path) -> Path:
    """Write the scene of an exported object at `pose` (7,) on a table; return its file relative to `root`."""
    place = f"{TABLETOP}/{SCALE}_pose{number:03}"
    file = SET / "scene_cfg" / name / f"{place}.npy"
    scene = _scene_configuration(name, place, pose)
    scene["scene"]["table"] = {"type": "plane", "pose": IDENTITY_POSE.copy(), "size": np.array([0.0, 0.0, 1.0])}
    save_record(root / file, scene)
    return file


def save_record(file: Path, record: Row) -> None:
    """Write a dictionary as DexGraspBench does: a pickle in a `.npy` file."""
    file.parent.mkdir(parents=True, exist_ok=True)
    np.save(file, np.array(record, dtype=object), allow_pickle=True)


def _scene_configuration(name: str, place: str, pose: Floats) -> dict[str, Any]:
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


def check_table(placed: PlacedGrasps) -> None:
    """Raise InputError unless the scenes are a table with its top at z = 0 and nothing else."""
    table = placed.supports[0].planes if len(placed.supports) == 1 else np.zeros((0, 4))
    if table.shape != (1, 4) or not np.allclose(table[0], [0, 0, 1, 0], rtol=0, atol=SAME):
        raise InputError(
            "DexGraspBench's tabletop test has only a table with its top at z = 0, but the shard has another scene; "
            "export grasps that were planned with --scene table"
        )


def tabletop_fields(mapping: HandMapping, hand: HandModel, grasps: GraspSet, row: int, pose: Floats) -> Row:
    """Return a grasp's fields for hands on arms; the evaluator ignores them.
    The object is at `pose` (7,). `approach_qpos` (W, 7 + J) is the open hand from standoff to pregrasp, `lift_qpos`
    (7 + J,) the raised squeeze."""
    assert grasps.approach is not None and grasps.coming is not None and grasps.lift is not None
    way = compose(pose, grasps.approach[row])
    raised = compose(pose, grasps.lift.hand_pose[row])
    return {
        "approach_qpos": np.array([mapping.qpos(hand, at, grasps.coming[row]) for at in way]),
        "lift_qpos": mapping.qpos(hand, raised, grasps.lift.joint_positions[row]),
    }


def scenes_on_tables(obj_pose: Floats) -> PlacedGrasps:
    """Return scenes with the object at its poses (N, 7) on a table; equal poses share a scene."""
    _, first, index = np.unique(np.round(obj_pose / SAME), axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    number = np.empty(len(order), np.intp)
    number[order] = np.arange(len(order))
    return PlacedGrasps(supports_of(SceneSpec(kind="table")), obj_pose[first[order]], number[index.reshape(-1)])


def object_of_scene(file: Path, scene_path: str) -> Row:
    """Return `obj_pose` and `obj_scale` of the object in the scene that a grasp's file names.
    The scene's path begins with `assets/`, relative to a folder above the file. Raises InputError: the path is another,
    or its file is missing or no scene."""
    place = PurePosixPath(scene_path)
    if place.is_absolute() or ".." in place.parts or place.parts[:1] != ("assets",):
        raise InputError(f"{file} names the scene {scene_path!r}; a scene lies below assets/")
    path = next((above / place for above in file.resolve().parents if (above / place).is_file()), None)
    if path is None:
        raise InputError(f"{file} names the scene {scene_path}, which no folder above contains; keep assets/ complete")
    found = load_npy(path)
    try:
        thing = found["scene"][found["task"]["obj_name"]]
        pose, scale = np.ravel(thing["pose"]).astype(float), np.ravel(thing["scale"]).astype(float)
    except (KeyError, TypeError, ValueError, IndexError):
        raise InputError(f"{path} is no scene with a task and its object") from None
    if pose.shape != IDENTITY_POSE.shape or not len(scale) or np.ptp(scale) > SAME:
        raise InputError(f"{path}: the object has a pose of {pose.size} numbers and the scale {scale.tolist()}")
    return {"obj_pose": pose, "obj_scale": float(scale[0])}


def add_trajectory(
    hand: HandModel, grasps: GraspSet, rows: Sequence[Row], obj_pose: Floats, mapping: HandMapping | None
) -> GraspSet:
    """Add approach and lift in the object's frame, if all rows have suitable ones.
    All approaches must have the same number of waypoints, and fixed joints."""
    if not all({"approach_qpos", "lift_qpos"} <= set(row) for row in rows):
        return grasps
    ways = [np.asarray(row["approach_qpos"], float) for row in rows]
    width = 7 + len(hand.joint_names)
    if {way.shape for way in ways} != {(len(ways[0]), width)} or np.ptp(ways, axis=1)[:, 7:].max() > SAME:
        return grasps
    lifts = np.array([np.ravel(row["lift_qpos"]) for row in rows], float)
    away = invert(obj_pose)

    def posture(qpos: Floats) -> Posture:
        root, joints = (qpos[:, :7], qpos[:, 7:]) if mapping is None else mapping.posture(hand, qpos)
        return Posture(compose(away, root), joints)

    path = [posture(np.array([way[k] for way in ways])) for k in range(len(ways[0]))]
    grasps.approach = np.stack([at.hand_pose for at in path], axis=1)
    grasps.coming, grasps.lift = path[-1].joint_positions, posture(lifts)
    return grasps
