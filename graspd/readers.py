"""Datasets as training samples: `Shards`, `Grasps`, `Pictures`, `Clouds` (docs/how-to/exchange.md)."""

from typing import Any

from graspd.service.readers import Clouds, DepthNoise, Grasps, Pictures, ShardCache, ShardFile, Shards, open_shards

__all__ = ["Clouds", "DepthNoise", "Grasps", "Pictures", "ShardCache", "ShardFile", "Shards"]
__all__ += ["hand_surface", "open_shards"]


def hand_surface(shard: Any, rows: Any) -> Any:
    """Return points (K, H, 3) on the hand's surface in grasps of a base shard, in the object's frame [m].
    Argument `hand_surface` of `Pictures.clouds`, for graspness. Raises NotFoundError: the hand is not found."""
    from graspd.worker.files.clouds import hand_surface as found

    return found(shard, rows)
