"""Copies of base shards that say in which share of other models their grasps hold."""

from __future__ import annotations

from pathlib import Path

from service.model.errors import InputError
from service.store.shards import carried, json_attribute, read_shard, write_shard
from worker.quality.referee.robust import Robustness


def copy_paths(source: Path, files: list[Path], out: Path) -> list[Path]:
    """Where the copies go: of a file, `out`; of a folder's, the same places in `out`, which must be new or empty.

    Raises:
        InputError: a file is no shard, would be written over, or lies in no folder.
    """
    if other := next((file for file in files if file.suffix != ".h5"), None):
        raise InputError(f"{other} is no shard of graspd: only these have columns for the shares")
    if source.is_dir():
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise InputError(f"{out} is there already; choose a folder that is not")
        return [out / file.relative_to(source) for file in files]
    if not out.parent.is_dir() or out.is_dir():
        raise InputError(f"{out} is no file that can be written: choose one in a folder that is there")
    return [out]


def write_copy(source: Path, out: Path, found: Robustness) -> None:
    """A base shard with the shares of its grasps; all else, its id too, is as it was.

    Raises:
        InputError: it is no base shard, or cannot be written there.
    """
    shard = read_shard(source, kind="base")
    said = json_attribute({"models": found.held.shape[1], "wanted": found.wanted})
    data = write_shard("base", {**shard.arrays, **found.columns}, {**carried(shard), "robust": said})
    part = out.with_name(f".{out.name}.part")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        part.write_bytes(data)
        part.replace(out)
    except OSError as error:
        raise InputError(f"{out} cannot be written: {error.strerror}") from None
