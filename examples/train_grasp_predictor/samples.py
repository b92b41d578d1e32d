"""From a picture with its grasps to what the network sees and what it should say.

The network sees a square crop around the object: colour, depth relative to the object's, and its mask. It answers in
a frame that follows from the crop alone: the camera's axes, the origin at the anchor, which is the middle of the crop
at the median depth of the object.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn.functional import interpolate

from service.model.transforms import quat_rotate, quat_to_matrix
from service.readers import Pictures, Shards
from service.store.shards import read_shard

#: Side of the crop [px], and how much larger than the object's box it is.
SIZE: Final = 64
MARGIN: Final = 1.3
#: Depth that becomes 1 in the network's input [m], and the most of it that is told.
DEPTH_UNIT_M: Final = 0.1
FAR: Final = 3.0
#: Least cosine between the palm's direction and the camera's: nobody can tell from a picture how a back is shaped.
SEEN: Final = 0.5
#: Label of the grasped object in segmentations.
_OBJECT: Final = 2


@dataclass(frozen=True)
class Example:
    """One picture."""

    image: torch.Tensor
    """(5, SIZE, SIZE): colour in [0, 1], depth, mask."""
    grasps: torch.Tensor
    """(K, 3 + 6 + J): hand position from the anchor [m], first two columns of its rotation, joints [rad]."""
    anchor: np.ndarray
    """(3,) in the camera's frame [m]."""
    object: str
    object_pose: np.ndarray
    """(7,) object in the camera's frame."""


def first_grasps(shards: Shards, count: int) -> Shards:
    """The first batches that hold `count` grasps of each hand and object, with their scenes and views; 0: all."""
    if not count:
        return shards
    held: dict[tuple[str, str], int] = {}
    kept: set[tuple[str, str, int]] = set()
    for file in sorted(shards.of("base"), key=lambda file: file.batch):
        pair = file.hand, file.object
        if held.get(pair, 0) < count:
            kept.add((*pair, file.batch))
            held[pair] = held.get(pair, 0) + len(read_shard(shards.path(file), kind="base")["quality/valid"])
    chosen = (file for file in shards if (file.hand, file.object, file.batch) in kept)
    return Shards(tuple(chosen), shards.store, shards.cache)


def examples(shards: Shards, approach: NDArray[np.float64]) -> Iterator[Example]:
    """All pictures that show enough of their object and have grasps from the side that the camera sees.

    Clearance of the table is no matter here: too few grasps have it, and the object is judged without a table.

    Args:
        shards: base, scene and views shards.
        approach: (3,) unit direction in which the palm looks, in the frame of the hand's root link.
    """
    for sample in Pictures(shards, clear=False, valid=False, with_grasps_only=True):
        crop, pose = crop_of(sample), np.asarray(sample["grasp/hand_pose"])
        towards = quat_rotate(pose[:, 3:], approach)[:, 2]
        seen = np.flatnonzero(towards > SEEN)
        if crop is not None and len(seen):
            image, anchor = crop
            targets = targets_of(pose[seen], np.asarray(sample["grasp/joint_positions"])[seen], anchor)
            yield Example(image, targets, anchor, sample["object"], np.asarray(sample["object/pose"]))


def crop_of(sample: dict[str, Any]) -> tuple[torch.Tensor, np.ndarray] | None:
    """The network's input and the anchor (3,) [m]; None where less than 30 pixels of the object are seen."""
    mask = sample["image/segmentation"] == _OBJECT
    if mask.sum() < 30:
        return None
    x0, y0, x1, y1 = np.asarray(sample["box/bounding_box_2d_tight"], float)
    depth = np.asarray(sample["image/depth"], float)
    middle = float(np.median(depth[mask]))
    centre, half = np.array([x0 + x1, y0 + y1]) / 2, MARGIN * max(x1 - x0, y1 - y0) / 2
    near = np.where(np.isfinite(depth), (depth - middle) / DEPTH_UNIT_M, FAR).clip(-FAR, FAR)
    planes = np.concatenate([np.moveaxis(sample["image/rgb"] / 255.0, -1, 0), near[None], mask[None]])
    k = np.asarray(sample["camera/intrinsics"], float)
    anchor = np.array([*((centre - k[:2, 2]) / np.diag(k)[:2] * middle), middle])
    return _resampled(planes, centre, half), anchor


def targets_of(pose: Any, joints: Any, anchor: Any) -> torch.Tensor:
    """(K, 3 + 6 + J) from hand poses (K, 7) in the camera's frame and joints (K, J)."""
    rotation = quat_to_matrix(np.asarray(pose)[:, 3:])
    columns = np.concatenate([rotation[:, :, 0], rotation[:, :, 1]], axis=1)
    rows = np.concatenate([np.asarray(pose)[:, :3] - anchor, columns, joints], axis=1)
    return torch.from_numpy(rows.astype(np.float32))


def _resampled(planes: Any, centre: Any, half: float) -> torch.Tensor:
    """The square around `centre` [px] with half side `half`, at SIZE x SIZE; outside the picture it is empty."""
    side = max(2, round(2 * half))
    x, y = (round(float(value)) - side // 2 for value in centre)
    height, width = planes.shape[1:]
    out = np.zeros((len(planes), side, side), np.float32)
    out[3] = FAR  # nothing is there
    a, b = max(0, y), min(height, y + side)
    c, d = max(0, x), min(width, x + side)
    out[:, a - y : b - y, c - x : d - x] = planes[:, a:b, c:d]
    return interpolate(torch.from_numpy(out)[None], size=(SIZE, SIZE), mode="area")[0]
