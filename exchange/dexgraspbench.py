"""DexGraspBench's layout: one pickled dictionary per grasp, and the files that its evaluator needs.

docs/how-to/exchange/dexgraspbench.md describes files and fields. `..._qpos` have root and joint order of the model that
a benchmark's configuration names; `HandMapping` relates both to graspd's hand."""

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np

from graspd.exchange import bench_scene
from graspd.exchange.bench_hand import GRASPS, HandMapping, benchmark_mapping, body_names, load_mapping, write_hand
from graspd.exchange.imported import ImportedGrasps, load_npy, scaled_object
from graspd.exchange.plan import plain_name
from graspd.service.model.errors import InputError
from graspd.service.model.transforms import IDENTITY_POSE, Floats, compose, invert
from graspd.worker.grasps import GraspSet, Posture
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.simulation.environment import PlacedGrasps

POSTURES: Final = ("pregrasp", "grasp", "squeeze")
NAME: Final = "graspd"  # prefix of the names of configurations and experiments


def read(path: Path, *, hand: str, obj: str) -> list[ImportedGrasps]:
    """Read a file or folder: one set of free grasps, and one of grasps on tables, for each scale.
    Without a mapping, root and joints are those of `hand`. Raises InputError: a file is invalid, or hands differ."""
    # Scenes are pickled dictionaries as well.
    files = [path] if path.is_file() else [f for f in sorted(path.rglob("*.npy")) if "scene_cfg" not in f.parts]
    if not files:
        raise InputError(f"{path} has no .npy files; DexGraspBench has one for each grasp")
    mappings = {load_mapping(file) for file in files}
    if len(mappings) > 1:
        names = ", ".join(sorted(one.config if one else "another" for one in mappings))
        raise InputError(f"{path} has grasps for {len(mappings)} models of a hand ({names}); give the folder of one")
    sets: dict[tuple[float, bool], list[bench_scene.Row]] = defaultdict(list)
    for file in files:
        for row in _load_rows(file):
            sets[_object_scale(row), _is_on_table(row)].append(row)
    model, mapping = hand_from_path(hand), mappings.pop()
    return [_imported_grasps(path, model, obj, sets[key], mapping) for key in sorted(sets)]


class BenchExport:
    """Export of many shards' grasps with all files that DexGraspBench's evaluator needs."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._hands = folder, dict[str, list[HandMapping]]()
        self.objects: dict[str, tuple[Path, Path]] = {}  # folder and scene file of each object
        self._scenes = Counter[str]()

    def write(
        self,
        hand: HandModel,
        obj: ObjectModel,
        grasps: GraspSet,
        rows: Sequence[int],
        placed: PlacedGrasps | None = None,
        *,
        name: str = "",
        prefix: str = "",
    ) -> list[Path]:
        """Write grasps; return the grasp files of the first experiment.
        The object is at the origin or, for `placed` grasps, on its table; scenes of an object are numbered on. Each of
        `write_models` gets an experiment. Raises InputError: the scenes are no tables."""
        if placed is not None:
            bench_scene.check_table(placed)
        folder, name = self._folder, name or plain_name(obj.name)
        if name not in self.objects:
            self.objects[name] = bench_scene.write_object(obj, name, folder)
        if hand.digest not in self._hands:
            self._hands[hand.digest] = write_models(hand, folder)
        obj_path, scene = self.objects[name]
        scenes = {0: (IDENTITY_POSE, scene)}
        number = np.zeros(len(grasps), np.intp)
        first = 0
        if placed is not None:
            number, first = placed.index, self._scenes[name]
            poses = np.asarray(placed.object_pose, float)
            self._scenes[name] += len(poses)
            used = sorted(set(number[list(rows)].tolist()))
            scenes = {k: (poses[k], bench_scene.write_table(name, poses[k], first + k, folder)) for k in used}
        paths: list[Path] = []
        for mapping in self._hands[hand.digest]:
            out = folder / "output" / f"{experiment_name(placed)}_{mapping.config}"
            mapping.write(out)
            place = out / GRASPS / name
            written = [
                place / f"{bench_scene.SCALE}_pose{first + number[row]:03}" / f"{prefix}{row}.npy" for row in rows
            ]
            for row, file in zip(rows, written, strict=True):
                pose, path = scenes[number[row]]
                record: bench_scene.Row = {
                    "obj_path": obj_path.as_posix(),
                    "obj_scale": 1.0,
                    "obj_pose": pose.copy(),
                    "scene_path": path.as_posix(),
                }
                record |= qpos_fields(mapping, hand, grasps, row, None if placed is None else pose)
                if placed is not None:
                    record |= bench_scene.tabletop_fields(mapping, hand, grasps, row, pose)
                bench_scene.save_record(file, record)
            paths = paths or written
        return paths


def write_models(hand: HandModel, folder: Path) -> list[HandMapping]:
    """Write a model of the hand below `folder`; return mappings to it and to the benchmark's own, if any."""
    config = f"{NAME}_{plain_name(hand.name)}"
    model = write_hand(hand, config, folder)
    built: Any = mujoco.MjModel.from_xml_path(str(folder / model))
    # MuJoCo's order of joints is the order in `qpos`.
    joints = tuple((built.joint(number).name,) * 2 for number in range(built.njnt))
    links = tuple(zip(body_names(hand), hand.body_names, strict=True))
    ours = HandMapping(hand.name, hand.root_link, config, model.as_posix(), tuple(IDENTITY_POSE), joints, links)
    return [ours, *filter(None, [benchmark_mapping(hand)])]


def experiment_name(placed: PlacedGrasps | None) -> str:
    """Return the name of the experiment of free grasps, or of grasps on tables."""
    return NAME if placed is None else f"{NAME}_{bench_scene.TABLETOP}"


def qpos_fields(
    mapping: HandMapping, hand: HandModel, grasps: GraspSet, row: int, pose: Floats | None
) -> bench_scene.Row:
    """Return the `..._qpos` of a grasp whose object is at the origin, or at `pose` (7,) on a table."""
    record: bench_scene.Row = {}
    for name in POSTURES:
        found: Posture = getattr(grasps, name)
        root = found.hand_pose[row] if pose is None else compose(pose, found.hand_pose[row])
        record[f"{name}_qpos"] = mapping.qpos(hand, root, found.joint_positions[row])
    return record


def _load_rows(file: Path) -> list[bench_scene.Row]:
    """Return the grasps of a file: one, or K if `..._qpos` are (K, 7 + J)."""
    found = load_npy(file)
    if not isinstance(found, dict):
        raise InputError(f"{file} is no dictionary, as DexGraspBench has it")
    if missing := [f"{name}_qpos" for name in POSTURES if f"{name}_qpos" not in found]:
        raise InputError(f"{file} has no {missing[0]}")
    # A file without the object's pose names a scene that has it.
    if "obj_pose" not in found and "scene_path" in found:
        found |= bench_scene.object_of_scene(file, str(found["scene_path"]))
    count = {len(found[f"{name}_qpos"]) if np.ndim(found[f"{name}_qpos"]) == 2 else 0 for name in POSTURES}
    rows = [found]
    if count != {0}:
        if len(count) > 1:
            raise InputError(f"{file}: the numbers of pregrasps, grasps and squeezes differ")
        rows = [{key: _value_of_grasp(value, k, count) for key, value in found.items()} for k in range(min(count))]
    for row in rows:
        if "scene_scale" in row:
            row["obj_scale"] = _object_scale(row) * float(np.ravel(row["scene_scale"])[0])
    return rows


def _value_of_grasp(value: Any, k: int, count: set[int]) -> Any:
    """Return grasp k's part of a value (K, ...); all grasps share other values."""
    each = isinstance(value, np.ndarray) and value.ndim > 0 and {len(value)} == count and value.dtype != object
    return value[k] if each else value


def _object_scale(row: bench_scene.Row) -> float:
    return float(np.ravel(row.get("obj_scale", 1.0))[0])


def _is_on_table(row: bench_scene.Row) -> bool:
    return any(part.startswith(bench_scene.TABLETOP) for part in str(row.get("scene_path", "")).split("/"))


def _imported_grasps(
    path: Path, hand: HandModel, obj: str, rows: list[bench_scene.Row], mapping: HandMapping | None
) -> ImportedGrasps:
    """Return grasps of one scale, all of a free object or all on tables."""
    scale = _object_scale(rows[0])
    thing = scaled_object(obj, scale)
    pose = np.array([np.ravel(row.get("obj_pose", IDENTITY_POSE)) for row in rows], float)

    def posture(name: str) -> Posture:
        try:
            qpos = np.array([np.ravel(row[f"{name}_qpos"]) for row in rows], float)
        except ValueError as error:
            raise InputError(f"{path}: the length of {name}_qpos differs between files: {error}") from None
        if qpos.shape[1] != 7 + len(hand.joint_names):
            raise InputError(
                f"{path}: {name}_qpos has {qpos.shape[1]} numbers, but {hand.name} needs 7 + {len(hand.joint_names)}; "
                "check --hand"
            )
        root, joints = (qpos[:, :7], qpos[:, 7:]) if mapping is None else mapping.posture(hand, qpos)
        return Posture(compose(invert(pose), root), joints)

    pregrasp, grasp, squeeze = map(posture, POSTURES)
    grasps = GraspSet(grasp, pregrasp, squeeze, np.full(len(rows), np.nan))
    published = np.array([int(bool(row["succ_flag"])) if "succ_flag" in row else -1 for row in rows], np.int8)
    name = str(rows[0].get("obj_path", thing.name)).rstrip("/").rsplit("/", 1)[-1]
    placed = bench_scene.scenes_on_tables(pose) if _is_on_table(rows[0]) else None
    if placed is not None:
        grasps = replace(bench_scene.add_trajectory(hand, grasps, rows, pose, mapping), scene=placed.index)
    return ImportedGrasps(hand, thing, grasps, name, scale, published, placed)
