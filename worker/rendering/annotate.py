"""Labels of a picture: segmentation, boxes in the picture and in space."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from service.model.transforms import Floats
from worker.rendering.cameras import Cameras

BACKGROUND, TABLE, OBJECT = 0, 1, 2


def tight_boxes(segmentation: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(V, 4) x_min y_min x_max y_max [px] around the visible object pixels of (V, H, W); nan where none is visible.

    Edges are pixel edges: a single pixel (i, j) gives i, j, i + 1, j + 1.
    """
    mask = segmentation == OBJECT
    boxes = np.full((len(mask), 4), np.nan, np.float32)
    for view in np.flatnonzero(mask.any(axis=(1, 2))):
        columns, rows = np.flatnonzero(mask[view].any(axis=0)), np.flatnonzero(mask[view].any(axis=1))
        boxes[view] = columns[0], rows[0], columns[-1] + 1, rows[-1] + 1
    return boxes


def loose_boxes(cameras: Cameras, points: Floats) -> NDArray[np.float32]:
    """(V, 4) box around the projection of the object's vertices (V, P, 3), occluded or outside the picture or not."""
    pixels, _ = cameras.project(points)
    return np.concatenate([pixels.min(axis=1), pixels.max(axis=1)], axis=1).astype(np.float32)


def box_corners(vertices: Floats) -> Floats:
    """(8, 3) corners of the object-aligned box; corner k takes the maximum of x, y, z where bit 0, 1, 2 of k is set."""
    bits = (np.arange(8)[:, None] >> np.arange(3)) & 1
    return np.where(bits, vertices.max(axis=0), vertices.min(axis=0))


def in_camera(cameras: Cameras, points: Floats) -> Floats:
    """Table-frame points (V, P, 3) in their camera frames (V, P, 3)."""
    return np.einsum("vij,vpj->vpi", cameras.extrinsics[:, :3, :3], points) + cameras.extrinsics[:, None, :3, 3]
