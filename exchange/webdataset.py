"""Pictures with their grasps as WebDataset tar files: members that share a key are one sample.

docs/how-to/exchange/webdataset.md describes the members. Data that a views shard lacks are omitted."""

import io
import json
import tarfile
import tempfile
from collections.abc import Iterable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from graspd.service.model.errors import InputError
from graspd.service.readers import Pictures, Shards
from graspd.service.store.shards import Shard, read_shard
from graspd.worker.rendering.export import describe, export_exr, export_png

_COLUMNS: Final = ("image/rgb", "image/depth", "image/segmentation", "camera/intrinsics", "camera/extrinsics")


def write(
    shards: Shards, folder: Path, *, pictures_a_file: int = 1000, valid: bool = True, unvalidated: bool = False
) -> list[Path]:
    """Write the pictures of views shards to `pictures-NNNNNN.tar`; `Pictures` selects their grasps.
    Raises InputError: there are no pictures, or `folder` has such files already."""
    pictures = open_pictures(shards, valid=valid, unvalidated=unvalidated)
    if not len(pictures):
        raise InputError("the shards contain no picture; submit the job with views, or run graspd render")
    folder.mkdir(parents=True, exist_ok=True)
    if any(folder.glob("pictures-*.tar")):
        raise InputError(f"{folder} holds tar files of pictures already; give another folder as --output")
    written = []
    for first in range(0, len(pictures), pictures_a_file):
        path = folder / f"pictures-{first // pictures_a_file:06}.tar"
        write_tar(pictures, range(first, min(first + pictures_a_file, len(pictures))), path)
        written.append(path)
    return written


def open_pictures(
    shards: Shards, *, valid: bool, unvalidated: bool = False, with_grasps_only: bool = False
) -> Pictures:
    which = {"valid": valid, "unvalidated": unvalidated, "with_grasps_only": with_grasps_only}
    return Pictures(shards, _COLUMNS, grasp_quality=("quality/epsilon", "quality/success"), **which)


def write_tar(pictures: Pictures, indices: Iterable[int], path: Path) -> None:
    """Write some of the pictures as samples of one tar file."""
    with tarfile.open(path, "w") as tar:
        for index in indices:
            for name, data in _sample_files(pictures.shards, pictures[index]):
                entry = tarfile.TarInfo(f"{index:08}.{name}")
                entry.size = len(data)
                tar.addfile(entry, io.BytesIO(data))


def _sample_files(shards: Shards, sample: dict[str, Any]) -> Iterator[tuple[str, bytes]]:
    with tempfile.TemporaryDirectory() as scratch:
        png, exr = Path(scratch) / "file.png", Path(scratch) / "file.exr"
        yield "rgb.png", export_png(png, sample["image/rgb"]).read_bytes()
        yield "segmentation.png", export_png(png, sample["image/segmentation"]).read_bytes()
        yield "depth.exr", export_exr(exr, "Z", [sample["image/depth"]]).read_bytes()
    yield "json", json.dumps(_record(shards, sample), allow_nan=False).encode()


def _record(shards: Shards, sample: dict[str, Any]) -> dict[str, Any]:
    views = _views(shards.path(shards.by_id(sample["shard_id"])))
    grasps = {
        "hand_pose": sample["grasp/hand_pose"],
        "joint_positions": sample["grasp/joint_positions"],
        "base_row": sample["grasp/base_row"],
        "epsilon": sample["quality/epsilon"],
    }
    return {
        "hand": sample["hand"],
        "object": sample["object"],
        "views_shard": sample["shard_id"],
        "base_shard": sample["base_id"],
        "row": sample["row"],
        "grasps": {name: np.asarray(values, float).tolist() for name, values in grasps.items()},
        "grasp_frame": "camera",
        **describe(views, sample["row"]),
    }


@lru_cache(maxsize=1)
def _views(path: Path) -> Shard:
    """Return the views shard without its depth, cached while its samples are written."""
    return read_shard(path, kind="views", without=("image/depth",))
