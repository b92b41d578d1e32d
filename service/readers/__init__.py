"""Readers of datasets: shards from files, a folder or a store, as arrays or as training samples.

    from graspd.service.readers import Grasps, Pictures, open_shards

    shards = open_shards("demo-out/shards")                                # files
    shards = open_shards("s3://bucket/graspd", dataset="kitchen")          # a dataset's newest snapshot, cached here
    grasps = Grasps(shards)                                                # grasps[i]: one grasp as a dictionary
    arrays = grasps.arrays("grasp/hand_pose", "quality/epsilon")           # all of them as arrays
    pictures = Pictures(shards)                                            # a picture and the grasps of its scene
    clouds = pictures.clouds(points=1024, noise="stereo")                  # point clouds of a simulated depth camera

`service.readers.torch_data` wraps them for PyTorch; no other module here imports torch.
"""

from graspd.service.readers.clouds import Clouds
from graspd.service.readers.depth_noise import DepthNoise
from graspd.service.readers.files import ShardCache, ShardFile, Shards, open_shards
from graspd.service.readers.grasps import Grasps
from graspd.service.readers.pictures import Pictures

__all__ = ["Clouds", "DepthNoise", "Grasps", "Pictures", "ShardCache", "ShardFile", "Shards", "open_shards"]
