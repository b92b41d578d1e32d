"""Datasets as samples for training: `Shards`, `Grasps`, `Pictures`, `Clouds` of files or a store (docs/exchange.md)."""

from typing import Any

from service.readers import Clouds, DepthNoise, Grasps, Pictures, ShardCache, ShardFile, Shards, open_shards, prefetched

__all__ = [
    "Clouds",
    "DepthNoise",
    "Grasps",
    "Pictures",
    "ShardCache",
    "ShardFile",
    "Shards",
    "hand_surface",
    "open_shards",
    "prefetched",
]


def hand_surface(shard: Any, rows: Any) -> Any:
    """(K, H, 3) points on the hand's surface in grasps of a base shard, in the object's frame [m]: for graspness.

    Raises:
        NotFoundError: the hand that the shard was made with is not here.
    """
    from worker.files.clouds import hand_surface as found  # loads the hands' reader

    return found(shard, rows)
