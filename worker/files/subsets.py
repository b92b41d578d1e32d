"""Subsets of a dataset as their own base shards, and the selection of grasps by a command."""

import json
import re
from collections.abc import Callable, Mapping
from itertools import groupby
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from graspd.service.cli import load_settings
from graspd.service.model.base import DIGEST
from graspd.service.model.errors import ConflictError, InputError, NotFoundError
from graspd.service.readers import Shards, open_shards
from graspd.service.store import validity
from graspd.service.store.shards import Shard, read_shard, relative_path_of, shard_bytes_of_rows
from graspd.service.store.store import open_store

#: Function from the base shards of one hand on one object to a mask (N,) for each shard.
Chooser = Callable[[list[Shard]], list[NDArray[np.bool_]]]


def open_source(source: str) -> Shards:
    """Return the shards of a file or folder, or of a dataset or a job in this machine's store.
    Raises NotFoundError: none of these exists."""
    if "/" in source or source in (".", "..") or Path(source).exists():
        return open_shards(Path(source))
    try:
        store = open_store(load_settings().resolved_store_url, make=False)
    except NotFoundError as error:
        raise NotFoundError(f"{source} is no file or folder, and {error}") from None
    is_job = re.fullmatch(DIGEST, source) is not None
    return open_shards(store, job=source) if is_job else open_shards(store, dataset=source)


def require_empty_folder(folder: Path) -> None:
    """Raise ConflictError unless a folder to write is new or empty."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ConflictError(f"{folder} exists already; choose another folder")


def write_subset(shards: Shards, choose: Chooser, out: Path, *, said: Mapping[str, Any]) -> dict[str, int]:
    """Write base shards of selected grasps, `HAND/OBJECT/base-BATCH.h5`, and the selection, `subset.json`.
    Shards without selected grasps are left out. All columns of a grasp, including its scene, are unchanged.
    Return the numbers looked_at and kept (grasps), shards (written), and passed_over (shards of scenes and views).
    Raises ConflictError: the folder contains files already. InputError: nothing is selected."""
    require_empty_folder(out)
    looked_at = kept = 0
    ready: list[tuple[PurePosixPath, bytes]] = []
    for _, files in groupby(shards.of_kind("base"), key=lambda file: (file.hand, file.object)):
        together = [read_shard(shards.path(file), kind="base") for file in files]
        for shard, mask in zip(together, choose(together), strict=True):
            looked_at, kept = looked_at + len(mask), kept + int(mask.sum())
            if mask.any():
                ready.append((relative_path_of(shard, {one for one, _ in ready}), shard_bytes_of_rows(shard, mask)))
    if not ready:
        raise InputError(f"none of {looked_at} grasps is selected")
    for path, data in ready:
        (out / path).parent.mkdir(parents=True, exist_ok=True)
        (out / path).write_bytes(data)
    summary = {**said, "looked_at": looked_at, "kept": kept, "shards": [str(path) for path, _ in ready]}
    (out / "subset.json").write_text(json.dumps(summary, indent=1) + "\n")
    passed_over = len(shards) - len(shards.of_kind("base"))
    return {"looked_at": looked_at, "kept": kept, "shards": len(ready), "passed_over": passed_over}


UnvalidatedOption = Annotated[
    bool, typer.Option("--unvalidated", help="Select feasible grasps without validation instead of valid ones.")
]
EveryOption = Annotated[bool, typer.Option("--all", help="Select all grasps, including failed ones.")]


def select_grasps(base: Shard, *, unvalidated: bool = False, every: bool = False) -> tuple[NDArray[np.bool_], str]:
    """Return a mask (N,) of the selected grasps, and a name for the selection.
    Raises InputError: both options at once, or no such grasp; the message states what the shard contains."""
    if unvalidated and every:
        raise InputError("--unvalidated and --all exclude each other")
    count = len(base["quality/valid"])
    if every:
        mask, word = np.ones(count, bool), "grasps of any kind"
    else:
        mask = validity.selection_mask(base.arrays, unvalidated=unvalidated)
        word = "feasible grasps that are not validated" if unvalidated else "valid grasps"
    if not mask.any():
        raise InputError(f"{base.path or 'the shard'} contains no {word}; {_available_text(base, count)}")
    return mask, word


def _available_text(base: Shard, count: int) -> str:
    if waiting := int(validity.selection_mask(base.arrays, unvalidated=True).sum()):
        return f"{waiting} of its {count} are feasible but not validated: select them with --unvalidated"
    if valid := int(validity.valid_mask(base.arrays).sum()):
        return f"{valid} of its {count} are valid: leave out --unvalidated"
    return f"all {count} failed: select them with --all" if count else "it has no grasps"
