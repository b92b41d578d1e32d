"""Pinhole camera: pixels, rays and points. x right, y down, z forward; pixel centres at +0.5."""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.transforms import Floats

#: Relative difference of depth above which neighbouring pixels belong to two surfaces.
EDGE: Final = 0.02
#: Cost of a one-sided difference with unknown bend, equal to the cost of an edge between two faces.
_BEND_UNKNOWN: Final = 0.5


def pixel_rays(k: Floats, width: int, height: int) -> Floats:
    """Return rays (H, W, 3) with z = 1 in the camera frame, through the pixel centres."""
    columns = (np.arange(width) + 0.5 - k[0, 2]) / k[0, 0]
    rows = (np.arange(height) + 0.5 - k[1, 2]) / k[1, 1]
    x, y = np.meshgrid(columns, rows)
    return np.stack([x, y, np.ones_like(x)], axis=-1)


def back_project(k: Floats, depth: NDArray[Any]) -> Floats:
    """Back-project axial depth (H, W) to points (H, W, 3) in the camera frame [m]; nan if not finite."""
    seen = np.where(np.isfinite(depth), np.asarray(depth, float), np.nan)
    return pixel_rays(k, depth.shape[1], depth.shape[0]) * seen[..., None]


def surface_normals(points: Floats) -> Floats:
    """Compute unit normals (H, W, 3) of points (H, W, 3), directed toward the camera; nan where undefined.

    Tangents are one-sided differences, on the side with less bend and no jump, so that no normal mixes two faces. Bend
    is the second difference of 1 / z, which is linear in pixels on a plane.
    """
    along, down = _tangent(points, 1), _tangent(points, 0)
    normal = np.cross(down, along)
    with np.errstate(invalid="ignore", divide="ignore"):
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        away = np.einsum("hwc,hwc->hw", normal, points) > 0
    return np.where(away[..., None], -normal, normal)


def _tangent(points: Floats, axis: int) -> Floats:
    step = np.diff(points, axis=axis)
    gap = np.full_like(np.take(points, [0], axis=axis), np.nan)
    ahead, behind = np.concatenate([step, gap], axis=axis), np.concatenate([gap, step], axis=axis)
    depth = points[..., 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        bend = np.abs(np.diff(1 / depth, 2, axis=axis)) * np.take(depth, range(1, depth.shape[axis] - 1), axis=axis)
    none = np.full_like(np.take(depth, [0, 0], axis=axis), np.nan)
    bent_ahead, bent_behind = np.concatenate([bend, none], axis=axis), np.concatenate([none, bend], axis=axis)
    cost_ahead, cost_behind = _cost(ahead, bent_ahead, points), _cost(behind, bent_behind, points)
    return np.where((cost_ahead <= cost_behind)[..., None], ahead, behind)


def _cost(step: Floats, bend: Floats, points: Floats) -> Floats:
    """Return the cost of a one-sided difference: bend, more across an edge, infinite without a point."""
    with np.errstate(invalid="ignore"):
        jump = np.abs(step[..., 2]) / points[..., 2]
    cost = np.fmin(bend, _BEND_UNKNOWN) + np.where(jump > EDGE, 1.0 + jump, 0.0)
    return np.where(np.isnan(jump), np.inf, cost)


def fitted_normals(
    points: Floats, row: NDArray[np.intp], column: NDArray[np.intp], *, radius: int, gap_m: Floats
) -> Floats:
    """Fit planes to the windows around pixels; return their unit normals (P, 3) toward the camera.

    Args:
        points: (H, W, 3) in the camera frame [m]; nan: a hole.
        row, column: (P,) pixels.
        radius: half width of a window; the full width is 2 radius + 1 pixels.
        gap_m: (P,) largest difference of depth to points of the window that count [m].

    Returns:
        Direction of least variance in each window; the direction to the camera if fewer than three points count.
    """
    offset = np.arange(-radius, radius + 1)
    height, width = points.shape[:2]
    rows = np.clip(row[:, None, None] + offset[:, None], 0, height - 1)
    columns = np.clip(column[:, None, None] + offset[None, :], 0, width - 1)
    centre = points[row, column]
    window = points[rows, columns].reshape(len(row), len(offset) ** 2, 3) - centre[:, None]
    with np.errstate(invalid="ignore"):
        counts = np.abs(window[..., 2]) <= gap_m[:, None]
    weight = counts.astype(float)
    window = np.where(counts[..., None], window, 0.0)
    total = np.maximum(weight.sum(1), 1.0)
    middle = window.sum(1) / total[:, None]
    spread = np.einsum("pni,pnj->pij", window, window) / total[:, None, None] - middle[:, :, None] * middle[:, None, :]
    normal = np.linalg.eigh(spread)[1][..., 0]
    few = weight.sum(1) < 3
    toward = -centre / np.maximum(np.linalg.norm(centre, axis=-1, keepdims=True), 1e-12)
    normal = np.where(few[:, None], toward, normal)
    return np.where(np.einsum("pc,pc->p", normal, centre)[:, None] > 0, -normal, normal)
