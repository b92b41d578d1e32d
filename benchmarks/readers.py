"""Samples per second of the readers against plain HDF5: `python -m benchmarks.readers SHARDS [--json]`.

SHARDS is a folder with base, scene and views shards, `demo-out/shards` say. One run, warm: all ways in turn, five
times; of each the best pass counts. A ratio is to plain h5py that reads the same samples as many at a time.
"""

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
import typer

from service.readers import Grasps, Pictures, Shards, open_shards
from service.readers.grasps import DEFAULT_COLUMNS

ROUNDS = 5
PICTURE = ("image/rgb", "image/depth", "image/segmentation", "camera/intrinsics", "camera/extrinsics")


@dataclass(frozen=True)
class Way:
    """A way to read: a pass that counts its samples, and the name of the plain way it is held against."""

    work: Callable[[], int]
    against: str


def plain_columns(shards: Shards) -> int:
    """Every column of the default sample, whole, by h5py."""
    count = 0
    for file in shards.of("base"):
        with h5py.File(shards.path(file), "r") as opened:
            columns = [opened[name][()] for name in DEFAULT_COLUMNS]
            count += len(columns[0])
    return count


def plain_rows(shards: Shards) -> int:
    """The same grasp by grasp, each file opened once."""
    return _row_by_row(shards, "base", DEFAULT_COLUMNS)


def plain_pictures(shards: Shards) -> int:
    """Colour, depth, labels and camera of every picture, one by one, each file opened once."""
    return _row_by_row(shards, "views", PICTURE)


def _row_by_row(shards: Shards, kind: str, columns: Sequence[str]) -> int:
    count = 0
    for file in shards.of(kind):
        with h5py.File(shards.path(file), "r") as opened:
            for row in range(len(opened[columns[0]])):
                for name in columns:
                    opened[name][row]
                count += 1
    return count


def ways(shards: Shards) -> dict[str, Way]:
    """All ways there are to read these shards."""
    found = {
        "h5py, whole columns": Way(lambda: plain_columns(shards), "h5py, whole columns"),
        "Grasps.arrays": Way(lambda: sum(map(arrays_of, by_hand(shards))), "h5py, whole columns"),
        "h5py, grasp by grasp": Way(lambda: plain_rows(shards), "h5py, grasp by grasp"),
        "Grasps, one by one": Way(lambda: sum(1 for _ in Grasps(shards, valid=False)), "h5py, grasp by grasp"),
    }
    if shards.of("views"):
        pictures = Pictures(shards)
        found["h5py, picture by picture"] = Way(lambda: plain_pictures(shards), "h5py, picture by picture")
        found["Pictures, one by one"] = Way(lambda: sum(1 for _ in pictures), "h5py, picture by picture")
    try:
        return found | loaders(shards)
    except ModuleNotFoundError:
        typer.echo("torch is not installed: its loaders are left out", err=True)
        return found


def loaders(shards: Shards) -> dict[str, Way]:
    """The same through PyTorch's DataLoader."""
    import torch
    from torch.utils.data import DataLoader

    from service.readers.torch_data import Samples, ShuffledShards, collate

    torch.set_num_threads(1)  # on a busy machine the threads of one copy wait for one another
    found = {}
    for processes in (0, 2):
        streams = [
            DataLoader(ShuffledShards(own, valid=False), batch_size=64, num_workers=processes)
            for own in by_hand(shards)
        ]
        found[f"ShuffledShards, {processes} processes"] = Way(rows_of(streams), "h5py, grasp by grasp")
        if shards.of("views"):
            pictures = DataLoader(Samples(Pictures(shards)), 8, num_workers=processes, collate_fn=collate)
            found[f"Pictures, DataLoader, {processes} processes"] = Way(rows_of([pictures]), "h5py, picture by picture")
    return found


def by_hand(shards: Shards) -> list[Shards]:
    """The shards of each hand: hands differ in their joints, so that their grasps fit into no common array."""
    return [shards.only(hands=[hand]) for hand in dict.fromkeys(file.hand for file in shards)]


def arrays_of(shards: Shards) -> int:
    """All grasps of one hand as arrays."""
    return len(Grasps(shards, valid=False).arrays()["hand"])


def rows_of(loaders: list[Any]) -> Callable[[], int]:
    """A pass over loaders that counts their samples."""
    return lambda: sum(len(batch["row"]) for batch in itertools.chain.from_iterable(loaders))


def run(shards: Shards) -> dict[str, float]:
    """Samples per second of each way."""
    chosen = ways(shards)
    for way in chosen.values():
        way.work()  # warms the files
    best = dict.fromkeys(chosen, 0.0)
    for _ in range(ROUNDS):
        for name, way in chosen.items():
            began = time.perf_counter()
            best[name] = max(best[name], way.work() / (time.perf_counter() - began))
    return best


def main() -> None:
    folders = [argument for argument in sys.argv[1:] if not argument.startswith("--")]
    if len(folders) != 1:
        sys.exit("give one folder of shards")
    shards = open_shards(Path(folders[0]))
    found = run(shards)
    if "--json" in sys.argv:
        typer.echo(json.dumps({name: round(value, 1) for name, value in found.items()}))
        return
    against = {name: way.against for name, way in ways(shards).items()}
    typer.echo("| way | samples/s | ratio |\n| --- | --: | --: |")
    for name, value in found.items():
        typer.echo(f"| {name} | {value:,.0f} | {value / found[against[name]]:.2f} |")


if __name__ == "__main__":
    main()
