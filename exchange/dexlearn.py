"""DexLearn's folder: files with several grasps each, splits, scenes, and partial point clouds.

DexLearn (Chen et al.) has the networks of BODex and Dexonomy. docs/how-to/exchange/dexlearn.md describes files. Root
poses and points share one frame: the table's or, for free grasps, the object's. Roots and joints are those of a hand
model of DexGraspBench, see `bench_hand`."""

import json
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from graspd.exchange.bench_hand import COLLECTED, HandMapping
from graspd.exchange.bench_scene import SET, TABLETOP, check_table, save_record, write_object, write_table
from graspd.exchange.dexgraspbench import POSTURES, experiment_name, qpos_fields, write_models
from graspd.exchange.plan import ExportPart, ExportSummary, PictureReference, pictures_without_pixels
from graspd.service.model.errors import InputError
from graspd.service.model.transforms import IDENTITY_POSE, Floats, apply, invert
from graspd.service.readers import DepthNoise, Pictures
from graspd.service.readers.clouds import CloudView
from graspd.worker.grasps import GraspSet

#: Folder of each `quality/grasp_type`; the number before the underscore is a network's input.
TYPES: Final = ("0_any", "1_power", "2_precision", "3_lateral")
VISION: Final = SET / "vision_data" / "azure_kinect_dk"
#: Number of points in a network's input; the loader samples them from a cloud with repetition.
POINTS: Final = 1024
_FREE: Final = -1


def write(
    lots: Sequence[ExportPart], pictures: Pictures, folder: Path, out: frozenset[str], noise: DepthNoise | None = None
) -> ExportSummary:
    """Write grasps, free or on tables, and the point clouds of their pictures."""
    if (folder / SET).exists():
        raise InputError(f"{folder} holds objects of an export already; give another folder as --output")
    for lot in lots:
        if lot.placed is not None:
            check_table(lot.placed)
    scenes = _write_scenes(lots, folder)
    clouds, bare = _write_clouds(pictures, lots, scenes, folder, noise)
    done = ExportSummary({"grasps": 0, "scenes": len({*scenes.values()}), "clouds": clouds, "files": 0})
    if not clouds:
        done.notes.append("there are no pictures and so no clouds; render views into the grasps' folder: graspd render")
    elif bare:
        done.counts["scenes"] -= bare
        done.notes.append(f"no picture shows {bare} of the scenes; their grasps are left out")
    groups: dict[tuple[str, bool], list[ExportPart]] = defaultdict(list)
    for lot in lots:
        groups[lot.hand.digest, lot.placed is None].append(lot)
    for group in groups.values():
        _write_group(group, scenes, folder, out, done, seen=bool(clouds))
    names = {lot.name for lot in lots}
    if not out:
        done.notes.append("only one object, in both train.json and test.json: the test has no unseen object")
    for split, some in (("train", names - out), ("test", out or names)):
        (folder / SET / "valid_split" / f"{split}.json").write_text(json.dumps(sorted(some), indent=1) + "\n")
    return done


#: Scene file below the folder, by shard and scene; `_FREE` stands for free grasps, which have one file per object.
_Scenes = dict[tuple[str, int], Path]
#: Grasps of one shard that share scene file and grasp type.
_Part = tuple[ExportPart, Path, int, NDArray[np.intp]]


def _write_scenes(lots: Sequence[ExportPart], folder: Path) -> _Scenes:
    scenes: _Scenes = {}
    free: dict[str, Path] = {}
    count = Counter[str]()
    for lot in lots:
        if lot.name not in free:
            free[lot.name] = write_object(lot.obj, lot.name, folder)[1]
        if lot.placed is None:
            scenes[lot.id, _FREE] = free[lot.name]
            continue
        poses = np.asarray(lot.placed.object_pose, float)
        for scene in sorted({int(lot.placed.index[row]) for row in lot.rows}):
            scenes[lot.id, scene] = write_table(lot.name, poses[scene], count[lot.name], folder)
            count[lot.name] += 1
    return scenes


def _write_clouds(
    pictures: Pictures, lots: Sequence[ExportPart], scenes: _Scenes, folder: Path, noise: DepthNoise | None
) -> tuple[int, int]:
    """Write the object's cloud of each picture; return the numbers of clouds and of scenes without cloud."""
    on_table = {lot.id: lot.placed is not None for lot in lots}
    written = Counter[Path]()
    for look in pictures_without_pixels(pictures):
        scene = scenes.get((look.base, look.scene if on_table.get(look.base) else _FREE))
        if scene is None or not len(points := object_points(pictures, look, noise, on_table=on_table[look.base])):
            continue
        place = folder / VISION / scene.relative_to(SET / "scene_cfg").with_suffix("")
        place.mkdir(parents=True, exist_ok=True)
        np.save(place / f"partial_pc_{written[scene]:02}.npy", points.astype(np.float32))
        written[scene] += 1
    bare = set(scenes.values()) - set(written)
    for scene in bare if written else ():
        # DexLearn's test fails for a scene in the folder without a cloud.
        (folder / scene).unlink()
    return written.total(), len(bare)


def object_points(pictures: Pictures, look: PictureReference, noise: DepthNoise | None, *, on_table: bool) -> Floats:
    """Return the object's points (P, 3) in a picture [m], in the frame of the table or of the free object."""
    view = CloudView(pictures[look.index], noise, np.random.default_rng(look.index))
    points = view.points(*view.pixels(whole=False))
    return points if on_table else apply(invert(look.object_pose), points)


def _write_group(
    lots: list[ExportPart], scenes: _Scenes, folder: Path, out: frozenset[str], done: ExportSummary, *, seen: bool
) -> None:
    parts = [(lot, *part) for lot in lots for part in _rows_of(lot, scenes, folder, seen=seen)]
    listed = sorted({kind for _, _, kind, _ in parts if _is_in_both_splits(kind, parts, out)})
    if not listed:
        # Without a type that has objects in both splits, all grasps get one type.
        parts, listed = [(lot, scene, 0, rows) for lot, scene, rows in _merge_types(parts)], [0]
    done.counts["grasps"] += sum(len(rows) for *_, rows in parts)
    for mapping in write_models(lots[0].hand, folder):
        name = f"{experiment_name(lots[0].placed)}_{mapping.config}"
        top = folder / "assets" / "grasp" / name
        mapping.write(top)
        for lot, scene, kind, rows in parts:
            file = top / COLLECTED / TYPES[kind] / lot.name / scene.parent.name / f"{scene.stem}_{lot.id_hash}.npy"
            save_record(file, _record(mapping, lot, rows, scene))
        done.counts["files"] += len(parts)
        _write_configuration(folder, name, lots[0], [TYPES[kind] for kind in listed])


def _rows_of(
    lot: ExportPart, scenes: _Scenes, folder: Path, *, seen: bool
) -> Iterator[tuple[Path, int, NDArray[np.intp]]]:
    """Yield scene file, type, and rows of the part; with `seen`, skip scenes without a cloud."""
    index = np.full(len(lot.grasps), _FREE) if lot.placed is None else np.asarray(lot.placed.index)
    types = np.asarray(lot.shard.arrays.get("quality/grasp_type", np.zeros(len(index))), np.intp)
    for scene in sorted({int(index[row]) for row in lot.rows}):
        path = scenes[lot.id, scene]
        if seen and not (folder / path).is_file():
            continue
        rows = lot.rows[index[lot.rows] == scene]
        for kind in np.unique(types[rows]):
            yield path, int(kind), rows[types[rows] == kind]


def _is_in_both_splits(kind: int, parts: Sequence[_Part], out: frozenset[str]) -> bool:
    """Check whether a type has objects in both splits, as DexLearn needs it."""
    names = {lot.name for lot, _, other, _ in parts if other == kind}
    return not out or bool(names & out and names - out)


def _merge_types(parts: Sequence[_Part]) -> Iterator[tuple[ExportPart, Path, NDArray[np.intp]]]:
    together: dict[tuple[str, Path], list[_Part]] = defaultdict(list)
    for part in parts:
        together[part[0].id, part[1]].append(part)
    for (_, scene), some in together.items():
        yield some[0][0], scene, np.sort(np.concatenate([part[3] for part in some]))


def _record(mapping: HandMapping, lot: ExportPart, rows: NDArray[np.intp], scene: Path) -> dict[str, Any]:
    grasps: GraspSet = lot.grasps
    record: dict[str, Any] = {"scene_path": scene.as_posix(), "scene_scale": np.ones(len(rows))}
    poses = [None if lot.placed is None else np.asarray(lot.placed.object_pose[lot.placed.index[row]]) for row in rows]
    each = [qpos_fields(mapping, lot.hand, grasps, int(row), pose) for row, pose in zip(rows, poses, strict=True)]
    record |= {f"{name}_qpos": np.array([one[f"{name}_qpos"] for one in each]) for name in POSTURES}
    # DexLearn ignores the pose; the importer needs it.
    record["obj_pose"] = np.array([IDENTITY_POSE if pose is None else pose for pose in poses])
    return record | {"succ_flag": lot.verdict[rows], "row": np.asarray(rows)}


def _write_configuration(folder: Path, name: str, lot: ExportPart, types: list[str]) -> None:
    values: dict[str, Any] = {
        "num_workers": 8,
        "num_points": POINTS,
        "traj_length": len(POSTURES),
        "joint_num": len(lot.hand.joint_names),
        "grasp_type_lst": types,
        "grasp_type_cond": len(types) > 1,
        "pc_centering": False,
        "grasp_path": f"${{data_folder}}/grasp/{name}/{COLLECTED}",
        "object_path": "${data_folder}/object/graspd",
        "split_path": "valid_split",
        "pc_path": VISION.relative_to(SET).as_posix(),
        "test_split": "test",
        "test_scene_cfg": f"{'floating' if lot.placed is None else TABLETOP}/**.npy",
        "mini_test": False,
    }
    file = folder / "dexlearn" / "config" / "data" / f"{name}.yaml"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("".join(f"{key}: {json.dumps(value)}\n" for key, value in values.items()))
