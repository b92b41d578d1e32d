"""Datasets as samples for training: `Shards`, `Grasps` and `Pictures` of files or a store (docs/exchange.md)."""

from service.readers import Grasps, Pictures, ShardCache, ShardFile, Shards, open_shards

__all__ = ["Grasps", "Pictures", "ShardCache", "ShardFile", "Shards", "open_shards"]
