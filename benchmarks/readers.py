"""Samples per second of the readers against plain HDF5: `python -m benchmarks.readers SHARDS [--json]`.

SHARDS is a folder with base, scene and views shards, for example `demo-out/shards`. Each reader makes five warm passes,
alternating with the others; the best pass counts, by wall time and by processor time. Ratios are to plain h5py with the
same samples and the same number per read. Single pictures in random order are compared with plain h5py in bulk.
`--s3` reads only pictures: by byte ranges from an S3 server on this machine, compared with the local disk.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import typer

from graspd.service.readers import Grasps, Pictures, ShardCache, Shards, open_shards, prefetched
from graspd.service.readers.grasps import DEFAULT_COLUMNS
from graspd.service.readers.pictures import PictureAddress
from graspd.service.store.store import open_store
from tests.servers import S3Server

ROUNDS = 5
PICTURE = ("image/rgb", "image/depth", "image/segmentation", "camera/intrinsics", "camera/extrinsics")


@dataclass(frozen=True)
class Trajectory:
    """A reader: a pass that counts its samples, and the name of the plain reader for comparison."""

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
    for file in shards.of(kind):
        with h5py.File(shards.path(file), "r") as opened:
            found = [opened[name][()] for name in columns]
            count += len(found[0])
    return count


def _row_by_row(shards: Shards, kind: str, columns: Sequence[str]) -> int:
    count = 0
    for file in shards.of(kind):
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
    if shards.of("views"):
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
        "prefetched(Pictures), 2 threads": Trajectory(lambda: sum(1 for _ in prefetched(pictures)), bulk),
        "h5py, drawn one by one": Trajectory(lambda: plain_drawn(shards, order, pictures.places), bulk),
        "Pictures, drawn one by one": Trajectory(lambda: sum(1 for i in order if pictures[i]), bulk),
    }


def loaders(shards: Shards) -> dict[str, Trajectory]:
    import torch
    from torch.utils.data import DataLoader

    from graspd.service.readers.torch_data import Samples, ShuffledShards, collate

    torch.set_num_threads(1)  # under other load, threads of one copy would wait for one another
    found = {}
    for processes in (0, 2):
        streams = [
            DataLoader(ShuffledShards(own, valid=False), batch_size=64, num_workers=processes)
            for own in by_hand(shards)
        ]
        found[f"ShuffledShards, {processes} processes"] = Trajectory(rows_of(streams), "h5py, grasp by grasp")
        if shards.of("views"):
            pictures = DataLoader(Samples(Pictures(shards)), 8, num_workers=processes, collate_fn=collate)
            found[f"Pictures, DataLoader, {processes} processes"] = Trajectory(
                rows_of([pictures]), "h5py, pictures in bulk"
            )
    return found


def by_hand(shards: Shards) -> list[Shards]:
    """Return the shards of each hand: hands differ in their joints, so grasps have no common array."""
    return [shards.only(hands=[hand]) for hand in dict.fromkeys(file.hand for file in shards)]


def arrays_of(shards: Shards) -> int:
    return len(Grasps(shards, valid=False).arrays()["hand"])


def rows_of(loaders: list[Any]) -> Callable[[], int]:
    """Return a pass over loaders that counts their samples."""
    return lambda: sum(len(batch["row"]) for batch in itertools.chain.from_iterable(loaders))


def streamed(local: Shards, url: str, scratch: Path) -> dict[str, Trajectory]:
    """Return readers of pictures from a store with four prefetch threads, and from disk; passes start uncached."""
    store = open_store(url)
    files = []
    for file in local:
        data = local.path(file).read_bytes()
        key = f"shards/{file.kind}/{file.id}.h5"
        store.put(key, data)
        files.append(replace(file, path=None, key=key, sha256=hashlib.sha256(data).hexdigest()))
    remote = Shards(tuple(files), store, ShardCache(scratch), stream=True)
    here, there = Pictures(local, PICTURE), Pictures(remote, PICTURE)
    order = np.random.default_rng(0).permutation(len(here)).tolist()

    def fresh(order: Sequence[int] | None = None) -> int:
        remote.ranges.forget()
        return sum(1 for _ in prefetched(there, order, workers=4, ahead=16))

    return {
        "disk, in turn": Trajectory(lambda: sum(1 for _ in here), "disk, in turn"),
        "disk, in turn, 2 threads": Trajectory(lambda: sum(1 for _ in prefetched(here)), "disk, in turn"),
        "S3, in turn": Trajectory(fresh, "disk, in turn"),
        "disk, drawn": Trajectory(lambda: sum(1 for i in order if here[i]), "disk, drawn"),
        "S3, drawn": Trajectory(lambda: fresh(order), "disk, drawn"),
    }


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
    if "--s3" in sys.argv:
        with S3Server() as server, tempfile.TemporaryDirectory() as scratch:
            os.environ.update(server.environment)
            chosen = streamed(shards, server.url, Path(scratch))
            tell(chosen, run(chosen))
        return
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
