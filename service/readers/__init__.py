"""Readers of datasets: shards from files, a folder or a store, as arrays or as training samples.

    from graspd.service.readers import Grasps, Pictures, open_shards

    shards = open_shards("demo-out/shards")                                # files
    shards = open_shards("s3://bucket/graspd", dataset="kitchen")          # a dataset's newest snapshot, cached here
    grasps = Grasps(shards)                                                # grasps[i]: one grasp as a dictionary
    arrays = grasps.arrays("grasp/hand_pose", "quality/epsilon")           # all of them as arrays
    pictures = Pictures(shards)                                            # a picture and the grasps of its scene
    clouds = pictures.clouds(points=1024, noise="stereo")                  # point clouds of a simulated depth camera

`service.readers.torch_data` wraps them for PyTorch; no other module here imports torch. Names are imported on first
use, because reading a single shard needs few of them.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from graspd.service.readers.cache import ShardCache, prefetched
    from graspd.service.readers.clouds import Clouds
    from graspd.service.readers.depth_noise import DepthNoise
    from graspd.service.readers.files import ShardFile, Shards, open_shards
    from graspd.service.readers.grasps import Grasps
    from graspd.service.readers.pictures import Pictures

_LIVES_IN: Final = {
    "Clouds": "clouds",
    "DepthNoise": "depth_noise",
    "Grasps": "grasps",
    "Pictures": "pictures",
    "ShardCache": "cache",
    "ShardFile": "files",
    "Shards": "files",
    "open_shards": "files",
    "prefetched": "cache",
}

__all__ = [
    "Clouds",
    "DepthNoise",
    "Grasps",
    "Pictures",
    "ShardCache",
    "ShardFile",
    "Shards",
    "open_shards",
    "prefetched",
]


def __getattr__(name: str) -> Any:
    if name not in _LIVES_IN:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(import_module(f"{__name__}.{_LIVES_IN[name]}"), name)
    globals()[name] = found
    return found
