"""Samples per second of the readers against plain HDF5: `python -m benchmarks.readers SHARDS [--json]`.

SHARDS is a folder with base, scene and views shards, `demo-out/shards` say. One run, warm, each way the best of three.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import typer

from service.readers import Grasps, Pictures, Shards, open_shards
from service.readers.grasps import DEFAULT_COLUMNS


def rate(work: Callable[[], int]) -> float:
    """Samples per second: the best of three passes after one that warms the files."""
    work()
    best = 0.0
    for _ in range(3):
        began = time.perf_counter()
        best = max(best, work() / (time.perf_counter() - began))
    return best


def plain_grasps(shards: Shards) -> int:
    """Every column of the default sample, whole, by h5py."""
    count = 0
    for file in shards.of("base"):
        with h5py.File(shards.path(file), "r") as opened:
            columns = [opened[name][()] for name in DEFAULT_COLUMNS]
            count += len(columns[0])
    return count


def plain_pictures(shards: Shards) -> int:
    """Colour, depth and labels of every picture, one by one, by h5py."""
    count = 0
    for file in shards.of("views"):
        with h5py.File(shards.path(file), "r") as opened:
            for row in range(len(opened["camera/eye"])):
                for name in ("image/rgb", "image/depth", "image/segmentation"):
                    opened[name][row]
                count += 1
    return count


def run(folder: Path) -> dict[str, float]:
    """Samples per second by way of reading."""
    shards = open_shards(folder)
    found = {"grasps, h5py, whole columns": rate(lambda: plain_grasps(shards))}
    found["grasps, Grasps.arrays"] = rate(lambda: len(Grasps(shards, valid=False).arrays()["hand"]))
    grasps = Grasps(shards, valid=False)
    found["grasps, one by one"] = rate(lambda: sum(1 for _ in grasps))
    if shards.of("views"):
        pictures = Pictures(shards)
        found["pictures, h5py"] = rate(lambda: plain_pictures(shards))
        found["pictures, Pictures"] = rate(lambda: sum(1 for _ in pictures))
    try:
        found |= loaders(shards)
    except ModuleNotFoundError:
        typer.echo("torch is not installed: its loaders are left out", err=True)
    return found


def loaders(shards: Shards) -> dict[str, float]:
    """The same through PyTorch's DataLoader."""
    from torch.utils.data import DataLoader

    from service.readers.torch_data import Samples, ShuffledShards, collate

    found = {}
    for processes in (0, 2):
        stream = DataLoader(ShuffledShards(shards, valid=False), batch_size=64, num_workers=processes)
        found[f"grasps, ShuffledShards, {processes} processes"] = rate(rows_of(stream))
        if shards.of("views"):
            pictures = DataLoader(Samples(Pictures(shards)), 8, num_workers=processes, collate_fn=collate)
            found[f"pictures, DataLoader, {processes} processes"] = rate(rows_of(pictures))
    return found


def rows_of(loader: Any) -> Callable[[], int]:
    """A pass over a loader that counts its samples."""
    return lambda: sum(len(batch["row"]) for batch in loader)


def main() -> None:
    folders = [argument for argument in sys.argv[1:] if not argument.startswith("--")]
    if len(folders) != 1:
        sys.exit("give one folder of shards")
    found = run(Path(folders[0]))
    if "--json" in sys.argv:
        typer.echo(json.dumps({name: round(value, 1) for name, value in found.items()}))
        return
    for name, value in found.items():
        typer.echo(f"{name:45} {value:10,.0f} /s")


if __name__ == "__main__":
    main()
