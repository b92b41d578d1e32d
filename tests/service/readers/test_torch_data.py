"""PyTorch's loaders on shards; skipped where torch is not installed."""

from pathlib import Path
from typing import Any

import pytest

from graspd.service.readers import Grasps, Pictures, Shards, open_shards

torch = pytest.importorskip("torch", reason="torch is not installed; `pip install torch` runs these tests")
from torch.utils.data import DataLoader  # noqa: E402

from graspd.service.readers.torch_data import Samples, ShuffledShards, collate  # noqa: E402


def rows(batches: Any) -> list[tuple[str, int]]:
    return [(shard, int(row)) for batch in batches for shard, row in zip(batch["shard_id"], batch["row"], strict=True)]


@pytest.mark.parametrize("processes", [0, 2])
def test_every_grasp_comes_once_an_epoch(shards: Shards, processes: int) -> None:
    seen = rows(DataLoader(ShuffledShards(shards, buffer=16), batch_size=8, num_workers=processes))
    assert sorted(seen) == sorted((sample["shard_id"], sample["row"]) for sample in Grasps(shards))


def test_ranks_share_the_grasps(shards: Shards) -> None:
    parts = [rows(DataLoader(ShuffledShards(shards, rank=rank, ranks=2), batch_size=8)) for rank in range(2)]
    assert not set(parts[0]) & set(parts[1])
    assert len(parts[0]) + len(parts[1]) == len(Grasps(shards))


def test_another_epoch_has_another_order(shards: Shards) -> None:
    stream = ShuffledShards(shards, seed=3)
    first, again = rows(DataLoader(stream, batch_size=8)), rows(DataLoader(stream, batch_size=8))
    stream.epoch = 1
    assert first == again and first != rows(DataLoader(stream, batch_size=8))


def test_pictures_are_stacked_and_their_grasps_listed(shards: Shards) -> None:
    batch = next(iter(DataLoader(Samples(Pictures(shards)), batch_size=3, collate_fn=collate)))
    assert batch["image/rgb"].shape == (3, 16, 24, 3)
    assert [pose.shape[1] for pose in batch["grasp/hand_pose"]] == [7, 7, 7]
    assert batch["camera/intrinsics"].dtype is torch.float32


@pytest.mark.parametrize("processes", [0, 2])
def test_clouds_are_stacked_and_their_grasps_listed(box: Path, processes: int) -> None:
    clouds = Pictures(open_shards(box)).clouds(128, noise="stereo", seed=2)
    loader = DataLoader(Samples(clouds), batch_size=4, collate_fn=collate, num_workers=processes)
    batches = list(loader)
    assert [tuple(batch["cloud/points"].shape) for batch in batches] == [(4, 128, 3), (2, 128, 3)]
    assert batches[0]["cloud/points"].dtype is torch.float32
    assert [len(rows) for rows in batches[0]["grasp/hand_pose"]] == [3, 3, 3, 2]
    alone = torch.from_numpy(clouds[1]["cloud/points"])
    assert torch.equal(batches[0]["cloud/points"][1], alone)
