"""PyTorch datasets of shards. Importing this module imports torch; install any build of it.

from torch.utils.data import DataLoader
from graspd.service.readers import Pictures, open_shards
from graspd.service.readers.torch_data import Samples, ShuffledShards, collate

shards = open_shards("demo-out/shards")
DataLoader(Samples(Pictures(shards)), batch_size=16, shuffle=True, num_workers=4, collate_fn=collate)
DataLoader(Samples(Pictures(shards).clouds(1024, noise="stereo")), batch_size=64, collate_fn=collate)
DataLoader(ShuffledShards(shards, seed=1), batch_size=256, num_workers=4)     # for data larger than memory
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import torch
from torch.utils.data import Dataset, IterableDataset, default_collate, get_worker_info

from graspd.service.readers.clouds import OF_GRASPS
from graspd.service.readers.files import Shards
from graspd.service.readers.grasps import DEFAULT_COLUMNS, Grasps

Sample = dict[str, Any]


def to_tensors(sample: Sample) -> Sample:
    """Convert the arrays of a sample to tensors, float64 to float32; strings stay strings."""
    return {name: _tensor(value) for name, value in sample.items()}


def collate(samples: Sequence[Sample]) -> Sample:
    """Stack samples to a batch; the grasps of pictures and clouds stay lists of tensors."""
    has_scenes = "grasp/base_row" in samples[0]
    columns = {name: [sample[name] for sample in samples] for name in samples[0]}
    # Lists even if all scenes have equal numbers of grasps: the type must not depend on the numbers.
    is_list = {name: has_scenes and name.startswith(OF_GRASPS) for name in columns}
    return {name: values if is_list[name] else default_collate(values) for name, values in columns.items()}


class Samples(Dataset[Sample]):
    """Map-style dataset of `Grasps`, `Pictures` or `Clouds`, for a `DataLoader` with or without workers."""

    def __init__(self, source: Sequence[Sample], transform: Callable[[Sample], Sample] = to_tensors) -> None:
        self._source, self._transform = source, transform

    def __len__(self) -> int:
        return len(self._source)

    def __getitem__(self, index: int) -> Sample:
        return self._transform(self._source[index])


class ShuffledShards(IterableDataset[Sample]):
    """Grasps of any number of shards in random order, read shard by shard.

    Each `epoch` shuffles the shards and distributes them over the processes of a `DataLoader` and the ranks of a
    distributed run. A buffer mixes grasps of several shards.
    """

    def __init__(
        self,
        shards: Shards,
        columns: Sequence[str] = DEFAULT_COLUMNS,
        *,
        buffer: int = 4096,
        seed: int = 0,
        rank: int = 0,
        ranks: int = 1,
        transform: Callable[[Sample], Sample] = to_tensors,
        **selection: Any,
    ) -> None:
        """Args:
        shards: see `open_shards`.
        columns: columns of a sample.
        buffer: number of grasps from which the next one is drawn.
        seed: seed of the order; `epoch` changes it.
        rank, ranks: rank of this process, and number of processes of a distributed run.
        transform: maps a sample of arrays to the value that the loader collates.
        selection: `valid`, `unvalidated` and `where` of `Grasps`.
        """
        self.epoch = 0
        self._shards, self._columns, self._transform = shards, tuple(columns), transform
        self._selection, self._buffer = selection, max(1, buffer)
        self._seed, self._rank, self._ranks = seed, rank, ranks

    def __iter__(self) -> Iterator[Sample]:
        worker = get_worker_info()
        number, workers = (0, 1) if worker is None else (worker.id, worker.num_workers)
        share, shares = self._rank * workers + number, self._ranks * workers
        files = self._shards.of_kind("base")
        order = np.random.default_rng([self._seed, self.epoch]).permutation(len(files))[share::shares]
        draw = np.random.default_rng([self._seed, self.epoch, share])
        held: list[Sample] = []
        for at in order:
            shard = Shards((files[at],), self._shards.store, self._shards.cache)
            for sample in Grasps(shard, self._columns, **self._selection):
                held.append(sample)
                if len(held) > self._buffer:
                    yield self._transform(_pop_random(held, draw))
        while held:
            yield self._transform(_pop_random(held, draw))


def _pop_random(held: list[Sample], draw: np.random.Generator) -> Sample:
    at = int(draw.integers(len(held)))
    held[at], held[-1] = held[-1], held[at]
    return held.pop()


def _tensor(value: Any) -> Any:
    if not isinstance(value, np.ndarray):
        return value.item() if isinstance(value, np.generic) else value
    return torch.from_numpy(value.astype(np.float32) if value.dtype == np.float64 else value)
