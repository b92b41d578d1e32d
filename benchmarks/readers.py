"""Samples per second of readers compared with h5py: `python -m benchmarks.readers SHARDS [--json]`.

SHARDS is a folder with base, scene and views shards, for example `demo-out/shards`. Each reader makes five warm passes,
alternating with the other readers. The best pass counts, by wall time and by processor time. Ratios are relative to
h5py alone with the same samples per read. Single pictures in random order are compared with h5py in bulk."""

from __future__ import annotations

import itertools
import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import typer

from graspd.service.readers import Grasps, Pictures, Shards, open_shards
from graspd.service.readers.grasps import DEFAULT_COLUMNS
from graspd.service.readers.pictures import PictureAddress

ROUNDS = 5
PICTURE = ("image/rgb", "image/depth", "image/segmentation", "camera/intrinsics", "camera/extrinsics")


@dataclass(frozen=True)
class Trajectory:
    """A reader: a pass that counts its samples, and the name of the h5py reader for comparison."""

    work: Callable[[], int]
    against: str


def plain_columns(shards: Shards) -> int:
    """Read every column of the default sample at once with h5py."""
    return _whole(shards, "base", DEFAULT_COLUMNS)


def plain_rows(shards: Shards) -> int:
    """Read the same columns grasp by grasp; open each file once."""
    return _row_by_row(shards, "base", DEFAULT_COLUMNS)


def plain_pictures(shards: Shards) -> int:
    """Read colour, depth, labels and camera of every picture one by one; open each file once."""
    return _row_by_row(shards, "views", PICTURE)


def plain_bulk(shards: Shards) -> int:
    """Read the same columns of each file at once, the fastest way with h5py."""
    return _whole(shards, "views", PICTURE)


def plain_drawn(shards: Shards, order: Sequence[int], places: Sequence[PictureAddress]) -> int:
    """Read the same pictures in random order; each read opens its file."""
    for index in order:
        with h5py.File(shards.path(places[index].file), "r") as opened:
            for name in PICTURE:
                opened[name][places[index].row]
    return len(order)


def _whole(shards: Shards, kind: str, columns: Sequence[str]) -> int:
    count = 0
    for file in shards.of_kind(kind):
        with h5py.File(shards.path(file), "r") as opened:
            found = [opened[name][()] for name in columns]
            count += len(found[0])
    return count


def _row_by_row(shards: Shards, kind: str, columns: Sequence[str]) -> int:
    count = 0
    for file in shards.of_kind(kind):
        with h5py.File(shards.path(file), "r") as opened:
            for row in range(len(opened[columns[0]])):
                for name in columns:
                    opened[name][row]
                count += 1
    return count


def ways(shards: Shards) -> dict[str, Trajectory]:
    found = {
        "h5py, whole columns": Trajectory(lambda: plain_columns(shards), "h5py, whole columns"),
        "Grasps.arrays": Trajectory(lambda: sum(map(arrays_of, by_hand(shards))), "h5py, whole columns"),
        "h5py, grasp by grasp": Trajectory(lambda: plain_rows(shards), "h5py, grasp by grasp"),
        "Grasps, one by one": Trajectory(lambda: sum(1 for _ in Grasps(shards, valid=False)), "h5py, grasp by grasp"),
    }
    if shards.of_kind("views"):
        found |= of_pictures(shards)
    try:
        return found | loaders(shards)
    except ModuleNotFoundError:
        typer.echo("torch is not installed: its loaders are skipped", err=True)
        return found


def of_pictures(shards: Shards) -> dict[str, Trajectory]:
    """Return readers of pictures without PyTorch."""
    pictures = Pictures(shards, PICTURE)
    order = np.random.default_rng(0).permutation(len(pictures)).tolist()
    bulk = "h5py, pictures in bulk"
    return {
        bulk: Trajectory(lambda: plain_bulk(shards), bulk),
        "h5py, picture by picture": Trajectory(lambda: plain_pictures(shards), bulk),
        "Pictures, in turn": Trajectory(lambda: sum(1 for _ in pictures), bulk),
        "h5py, drawn one by one": Trajectory(lambda: plain_drawn(shards, order, pictures.places), bulk),
        "Pictures, drawn one by one": Trajectory(lambda: sum(1 for i in order if pictures[i]), bulk),
    }


def loaders(shards: Shards) -> dict[str, Trajectory]:
    import torch
    from torch.utils.data import DataLoader

    from graspd.service.readers.torch_data import Samples, ShuffledShards, collate

    torch.set_num_threads(1)  # under other load, threads that copy one tensor would wait for each other
    found = {}
    for processes in (0, 2):
        streams = [
            DataLoader(ShuffledShards(own, valid=False), batch_size=64, num_workers=processes)
            for own in by_hand(shards)
        ]
        found[f"ShuffledShards, {processes} processes"] = Trajectory(rows_of(streams), "h5py, grasp by grasp")
        if shards.of_kind("views"):
            pictures = DataLoader(Samples(Pictures(shards)), 8, num_workers=processes, collate_fn=collate)
            found[f"Pictures, DataLoader, {processes} processes"] = Trajectory(
                rows_of([pictures]), "h5py, pictures in bulk"
            )
    return found


def by_hand(shards: Shards) -> list[Shards]:
    """Return the shards of each hand: hands differ in their joints, so grasps have no common array."""
    return [shards.select(hands=[hand]) for hand in dict.fromkeys(file.hand for file in shards)]


def arrays_of(shards: Shards) -> int:
    return len(Grasps(shards, valid=False).arrays()["hand"])


def rows_of(loaders: list[Any]) -> Callable[[], int]:
    """Return a pass over loaders that counts their samples."""
    return lambda: sum(len(batch["row"]) for batch in itertools.chain.from_iterable(loaders))


@dataclass(frozen=True)
class Rate:
    by_clock: float
    by_processor: float
    """Samples per second of processor time of this process."""


def run(chosen: dict[str, Trajectory]) -> dict[str, Rate]:
    for way in chosen.values():
        way.work()  # fills the file cache
    best = dict.fromkeys(chosen, Rate(0.0, 0.0))
    for _ in range(ROUNDS):
        for name, way in chosen.items():
            clock, processor = time.perf_counter(), time.process_time()
            count = way.work()
            rate = Rate(count / (time.perf_counter() - clock), count / (time.process_time() - processor))
            best[name] = Rate(max(best[name].by_clock, rate.by_clock), max(best[name].by_processor, rate.by_processor))
    return best


def main() -> None:
    folders = [argument for argument in sys.argv[1:] if not argument.startswith("--")]
    if len(folders) != 1:
        sys.exit("give one folder of shards")
    shards = open_shards(Path(folders[0]))
    chosen = ways(shards)
    tell(chosen, run(chosen))


def tell(chosen: dict[str, Trajectory], found: dict[str, Rate]) -> None:
    if "--json" in sys.argv:
        typer.echo(json.dumps({name: round(rate.by_clock, 1) for name, rate in found.items()}))
        return
    typer.echo("| way | samples/s | ratio | ratio by processor time |\n| --- | --: | --: | --: |")
    for name, rate in found.items():
        plain = found[chosen[name].against]
        own = "" if "process" in name else f"{rate.by_processor / plain.by_processor:.2f}"
        typer.echo(f"| {name} | {rate.by_clock:,.0f} | {rate.by_clock / plain.by_clock:.2f} | {own} |")


if __name__ == "__main__":
    main()
