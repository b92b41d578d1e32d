"""Parts of a dataset as base shards of their own, and the choice of grasps that a command takes."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from graspd.service.cli import load_settings
from graspd.service.model.errors import InputError, NotFoundError
from graspd.service.readers import Shards, open_shards
from graspd.service.store import validity
from graspd.service.store.shards import Shard, part_of_shard, place_of, read_shard
from graspd.service.store.store import open_store

#: From the base shards of one hand on one object to the mask (N,) of each.
Chooser = Callable[[list[Shard]], list[NDArray[np.bool_]]]


@dataclass(frozen=True)
class Subset:
    """What was written."""

    looked_at: int
    kept: int
    files: list[Path]
    passed_over: int
    """Scene and views shards, whose rows name grasps by number and are not carried over."""


def shards_of(source: str, snapshot: str | None = None) -> Shards:
    """The shards of a file or folder, or of a dataset of this machine's store by its name.

    Raises:
        NotFoundError: there is no such thing.
    """
    if "/" in source or source in (".", "..") or Path(source).exists():
        return open_shards(Path(source))
    try:
        store = open_store(load_settings().resolved_store_url, make=False)
    except NotFoundError as error:
        raise NotFoundError(f"{source} is no file or folder, and {error}") from None
    return open_shards(store, dataset=source, snapshot=snapshot)


def base_shards(shards: Shards) -> Iterator[list[Shard]]:
    """The base shards of each hand and object, a list each."""
    pair, together = ("", ""), list[Shard]()
    for file in shards.of("base"):
        if (file.hand, file.object) != pair and together:
            yield together
            together = []
        pair = (file.hand, file.object)
        together.append(read_shard(shards.path(file), kind="base"))
    if together:
        yield together


def write_subset(shards: Shards, choose: Chooser, out: Path, *, said: Mapping[str, Any]) -> Subset:
    """Base shards of the chosen grasps, `HAND/OBJECT/base-BATCH.h5`, and `subset.json`: how they were chosen.

    A shard of which nothing is chosen is left out. What each grasp says, its scene too, is as it was.

    Raises:
        InputError: the folder holds files already, or cannot be made; or nothing is chosen.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out} is there already; choose a folder that is not")
    looked_at = kept = 0
    ready: list[tuple[PurePosixPath, bytes]] = []
    for together in base_shards(shards):
        for shard, mask in zip(together, choose(together), strict=True):
            looked_at, kept = looked_at + len(mask), kept + int(mask.sum())
            if mask.any():
                ready.append((place_of(shard, {one for one, _ in ready}), part_of_shard(shard, mask)))
    if not ready:
        raise InputError(f"none of {looked_at} grasps is chosen")
    files = [out / path for path, _ in ready]
    for path, (_, data) in zip(files, ready, strict=True):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    told = {**said, "looked_at": looked_at, "kept": kept, "shards": [str(path) for path, _ in ready]}
    (out / "subset.json").write_text(json.dumps(told, indent=1) + "\n")
    return Subset(looked_at, kept, files, len(shards) - len(shards.of("base")))


UnvalidatedOption = Annotated[
    bool,
    typer.Option("--unvalidated", help="Instead of valid grasps those that are feasible and that are not validated."),
]
EveryOption = Annotated[bool, typer.Option("--all", help="All grasps, also those that failed.")]


def choose(base: Shard, *, unvalidated: bool = False, every: bool = False) -> tuple[NDArray[np.bool_], str]:
    """(N,) the grasps that are taken, and what they are called.

    Raises:
        InputError: both wishes at once, or there is no such grasp; tells what there is.
    """
    if unvalidated and every:
        raise InputError("--unvalidated and --all exclude each other")
    count = len(base["quality/valid"])
    if every:
        mask, word = np.ones(count, bool), "grasps of any kind"
    else:
        mask = validity.chosen(base.arrays, unvalidated=unvalidated)
        word = "feasible grasps that are not validated" if unvalidated else "valid grasps"
    if not mask.any():
        raise InputError(f"{base.path or 'the shard'} holds no {word}; {_there_are(base, count)}")
    return mask, word


def _there_are(base: Shard, count: int) -> str:
    waiting = int(validity.chosen(base.arrays, unvalidated=True).sum())
    valid = int(validity.valid(base.arrays).sum())
    if waiting:
        return f"{waiting} of its {count} are feasible and were validated by nobody: take them with --unvalidated"
    if valid:
        return f"{valid} of its {count} are valid: leave out --unvalidated"
    return f"all {count} failed: take them with --all" if count else "it has no grasp at all"
