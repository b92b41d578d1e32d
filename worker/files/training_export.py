"""From a folder of shards to the folder that another project trains on: grasps, their pictures, and who is held out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from service.model.errors import InputError
from service.readers import Pictures, Shards, open_shards
from service.store import standing
from service.store.shards import Shard, read_shard
from worker.files.cases import load_case
from worker.files.choice import choose
from worker.files.exchange.imported import plain_name
from worker.files.exchange.lots import SEEN, Lot, held_out
from worker.files.exchange.written import Written

FORMATS: Final = ("dexlearn", "dexgraspnet2", "graspgen")

#: Formats that tell good grasps from bad ones.
LABELLED: Final = ("graspgen",)


@dataclass(frozen=True)
class TrainingWishes:
    """What a user asks for, as the command line has it."""

    hand: str | None = None
    obj: str | None = None
    unjudged: bool = False
    every: bool = False
    held_out: float = 0.2
    """Share of the objects that a network is tested on."""


def export_training(source: Path, format_: str, wishes: TrainingWishes, folder: Path) -> Written:
    """Write the grasps of a folder of shards as others train on them.

    Raises:
        InputError: unknown format, no such grasps, a share that is none, or what the format's writer refuses.
    """
    from worker.files.exchange import dexgraspnet2, dexlearn, graspgen

    if format_ not in FORMATS:
        raise InputError(f"there is no training format {format_!r}; choose one of {', '.join(FORMATS)}")
    if not 0 < wishes.held_out < 1:
        raise InputError(f"--held-out is {wishes.held_out:g}; give a share of the objects between 0 and 1")
    shards = open_shards(source)
    lots = _lots(shards, format_, wishes)
    out = held_out({lot.name: lot.obj.digest for lot in lots}, wishes.held_out)
    if format_ == "graspgen":
        return graspgen.write(lots, folder, out)
    writer = dexlearn.write if format_ == "dexlearn" else dexgraspnet2.write
    return writer(lots, _pictures(shards, wishes), folder, out)


def _lots(shards: Shards, format_: str, wishes: TrainingWishes) -> list[Lot]:
    """Grasps of all base shards that have some of the kind that is asked for."""
    lots: list[Lot] = []
    digests: dict[str, str] = {}
    refused: InputError | None = None
    for file in shards.of("base"):
        path = shards.path(file)
        shard = read_shard(path, kind="base")
        try:
            mask = _chosen(shard, format_, wishes)
        except InputError as error:
            refused = error
            continue
        case = load_case(path, hand=wishes.hand, obj=wishes.obj)
        name = plain_name(case.obj.name)
        if digests.setdefault(name, case.obj.digest) != case.obj.digest:
            name = f"{name}-{case.obj.digest[:8]}"
        rows = np.flatnonzero(mask)
        lots.append(Lot(file.id, name, case.hand, case.obj, case.grasps, rows, _held(shard), shard.arrays, case.placed))
    if not lots:
        raise refused or InputError("there is no base shard, so there are no grasps")
    return lots


def _chosen(shard: Shard, format_: str, wishes: TrainingWishes) -> np.ndarray:
    """(N,) grasps that go into the export. A format that labels grasps gets good ones and bad ones."""
    if format_ not in LABELLED:
        return choose(shard, unjudged=wishes.unjudged, every=wishes.every)[0]
    judged = standing.judged(shard.arrays)
    if wishes.unjudged or not judged.any():
        raise InputError(
            f"{format_} says of each grasp whether it holds; judge them first: graspd synth without --referee none"
        )
    return judged


def _held(shard: Shard) -> np.ndarray:
    judged, valid = standing.judged(shard.arrays), standing.valid(shard.arrays)
    return np.where(judged, valid, -1).astype(np.int8)


def _pictures(shards: Shards, wishes: TrainingWishes) -> Pictures:
    """The pictures whose grasps are among the shards."""
    columns = (*SEEN, "camera/eye")
    return Pictures(shards, columns, grasp_quality=(), valid=not wishes.every, unjudged=wishes.unjudged)
