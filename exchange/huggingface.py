"""A folder for `datasets.load_dataset`: a table of grasps, and one of pictures with their grasps.

`GRASPS` and `PICTURES` list the columns; docs/how-to/exchange/huggingface.md describes them with units and frames."""

import io
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from graspd.exchange.plan import ExportPart, ExportSummary
from graspd.service import parquet
from graspd.service.model.errors import InputError
from graspd.service.model.transforms import IDENTITY_POSE, Floats
from graspd.service.readers import DepthNoise, Pictures
from graspd.service.readers.clouds import CloudView
from graspd.service.readers.trajectories import scene_spec_of
from graspd.service.store.shards import Shard
from graspd.worker.grasps import GraspSet, Posture
from graspd.worker.rendering.export import PNG_STEP_M
from graspd.worker.rendering.sheets import metric_at_threshold

POSTURES: Final = ("pregrasp", "grasp", "squeeze")
#: Values of column `scene_kind` that `read` supports.
FREE: Final = "free"
TABLE: Final = "table"
#: Columns of grasps, with the names of their types in `parquet.arrow_type`.
GRASPS: Final = {
    "hand": "text",
    "object": "text",
    "shard": "text",
    "row": "int64",
    "root_link": "text",
    "joint_names": "text[]",
    **{f"{name}_{what}": word for name in POSTURES for what, word in (("pose", "float64[7]"), ("joints", "float64[]"))},
    "verdict": "int8",
    "verdict_level": "text",
    "epsilon": "float64",
    "penetration_depth_mm": "float64",
    "grasp_type": "int32",
    "scene_kind": "text",
    "scene": "int32",
    "object_pose": "float64[7]",
}
#: Columns of pictures.
PICTURES: Final = {
    "hand": "text",
    "object": "text",
    "shard": "text",
    "row": "int64",
    "scene": "int32",
    "rgb": parquet.IMAGE,
    "depth": parquet.IMAGE,
    "segmentation": parquet.IMAGE,
    "intrinsics": "float64[3][3]",
    "extrinsics": "float64[4][4]",
    "object_pose": "float64[7]",
    "grasp_shard": "text",
    "grasp_rows": "int64[]",
    "hand_poses": "float64[7][]",
    "joint_positions": "float64[][]",
}
_PICTURES_AT_ONCE: Final = 50  # number of pictures in a row group


def write(
    lots: Sequence[ExportPart], pictures: Pictures, folder: Path, out: frozenset[str], noise: DepthNoise | None = None
) -> ExportSummary:
    """Write both tables, each with splits `train` and `test`; held-out objects are in `test`.
    Raises InputError: `folder` has such tables already, or pyarrow is missing."""
    parquet.import_pyarrow()
    if (folder / "grasps").exists():
        raise InputError(f"{folder} holds a table of grasps already; give another folder as --output")
    done = ExportSummary({"grasps": 0, "pictures": 0, "files": 0})
    sides = {"train": {lot.name for lot in lots} - out, "test": set(out)}
    for split, some in sides.items():
        if not some:
            done.notes.append("only one object: all grasps are in train, and there is no test split")
            continue
        mine = [lot for lot in lots if lot.name in some]
        file = folder / "grasps" / f"{split}-00000.parquet"
        done.counts["grasps"] += parquet.write(file, parquet.arrow_schema(GRASPS), map(_grasps, mine))
        done.counts["files"] += 1
        if len(pictures):
            file = folder / "pictures" / f"{split}-00000.parquet"
            groups = picture_rows(pictures, range(len(pictures)), {lot.id: lot.name for lot in mine}, noise)
            done.counts["pictures"] += parquet.write(file, parquet.arrow_schema(PICTURES), groups)
            done.counts["files"] += 1
    splits = [split for split, some in sides.items() if some]
    tables = table_configs(["grasps", "pictures"] if len(pictures) else ["grasps"], splits)
    # The YAML head of the card is JSON, which is valid YAML.
    (folder / "README.md").write_text(
        f"---\nconfigs: {json.dumps(tables)}\n---\n\n# Grasps made with graspd\n\n"
        "Columns, units and frames: docs/how-to/exchange/huggingface.md of graspd.\n"
    )
    return done


def table_configs(tables: Sequence[str], splits: Sequence[str]) -> list[dict[str, Any]]:
    """Return the `configs` of a dataset card: `TABLE/SPLIT-*.parquet`; the first table is the default."""
    return [
        {
            "config_name": table,
            "default": table == tables[0],
            "data_files": [{"split": split, "path": f"{table}/{split}-*.parquet"} for split in splits],
        }
        for table in tables
    ]


def _grasps(lot: ExportPart) -> list[dict[str, Any]]:
    own = {"hand": lot.hand.name, "root_link": lot.hand.root_link, "joint_names": list(lot.hand.joint_names)}
    return [row | own for row in grasp_rows(lot.shard, lot.id, lot.name, lot.rows)]


def grasp_rows(shard: Shard, shard_id: str, obj: str, selected: NDArray[np.intp]) -> list[dict[str, Any]]:
    """Return rows of the table of grasps: the selected ones of a base shard, on the object of this name."""
    said, arrays, grasps = shard.attributes, shard.arrays, GraspSet.from_columns(shard.arrays)
    placed = np.asarray(arrays["scene/object_pose"], float) if "scene/object_pose" in arrays else None
    verdict = np.asarray(arrays.get("quality/success", np.full(len(grasps), -1)), np.int8)
    epsilon = metric_at_threshold(arrays, "quality/epsilon")
    spec = scene_spec_of(shard)
    kind = FREE if placed is None or spec is None else spec.kind
    types = np.asarray(arrays.get("quality/grasp_type", np.zeros(len(grasps), int)))
    rows = []
    for row in selected.tolist():
        one: dict[str, Any] = {
            "hand": str(said.get("hand", "")),
            "object": obj,
            "shard": shard_id,
            "row": row,
            "root_link": str(said.get("root_link", "")),
            "joint_names": said.get("joint_names", []),
            "verdict": int(verdict[row]),
            "verdict_level": str(said.get("verdict_level", "none")),
            "epsilon": float(epsilon[row]),
            "penetration_depth_mm": float(arrays["quality/penetration_depth_mm"][row]),
            "grasp_type": int(types[row]),
            "scene_kind": kind,
            "scene": -1,
            "object_pose": IDENTITY_POSE.tolist(),
        }
        if placed is not None:
            scene = int(arrays["grasp/scene_index"][row])
            one |= {"scene": scene, "object_pose": placed[scene].tolist()}
        for name in POSTURES:
            part: Posture = getattr(grasps, name)
            one |= {f"{name}_pose": part.hand_pose[row].tolist(), f"{name}_joints": part.joint_positions[row].tolist()}
        rows.append(one)
    return rows


def picture_rows(
    pictures: Pictures, indices: Iterable[int], names: Mapping[str, str], noise: DepthNoise | None = None
) -> Iterator[list[dict[str, Any]]]:
    """Yield groups of rows of the table of pictures; `names` has the object of each base shard to include."""
    group: list[dict[str, Any]] = []
    for index in indices:
        sample = pictures[index]
        if sample["base_id"] in names:
            depth = CloudView(sample, noise, np.random.default_rng(index)).seen
            group.append(_picture(sample, names[sample["base_id"]], depth))
        if len(group) == _PICTURES_AT_ONCE:
            yield group
            group = []
    if group:
        yield group


def _picture(sample: Mapping[str, Any], name: str, depth: Floats) -> dict[str, Any]:
    steps = np.where(depth / PNG_STEP_M < np.iinfo(np.uint16).max + 0.5, np.rint(depth / PNG_STEP_M), 0)
    return {
        "hand": sample["hand"],
        "object": name,
        "shard": sample["shard_id"],
        "row": int(sample["row"]),
        "scene": int(sample["scene"]),
        "rgb": png(sample["image/rgb"]),
        "depth": png(steps.astype(np.uint16)),
        "segmentation": png(sample["image/segmentation"]),
        "intrinsics": np.asarray(sample["camera/intrinsics"], float).tolist(),
        "extrinsics": np.asarray(sample["camera/extrinsics"], float).tolist(),
        "object_pose": np.asarray(sample["object/pose"], float).tolist(),
        "grasp_shard": sample["base_id"],
        "grasp_rows": np.asarray(sample["grasp/base_row"]).tolist(),
        "hand_poses": np.asarray(sample["grasp/hand_pose"], float).tolist(),
        "joint_positions": np.asarray(sample["grasp/joint_positions"], float).tolist(),
    }


def png(pixels: NDArray[Any]) -> dict[str, Any]:
    """Return a picture (H, W) or (H, W, 3) as a PNG file, in the form that Hugging Face's readers expect."""
    data = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(data, format="PNG", compress_level=1)
    return {"bytes": data.getvalue(), "path": None}
