"""Forces that balance, of many grasps at once: non-negative least squares on the CPU or a GPU."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy.optimize import nnls

from worker.simulation.kernels import balance as kernels

Floats = NDArray[np.float64]


def nonnegative_weights(matrix: Floats, target: Floats, ridge: float, count: NDArray[np.integer[Any]]) -> Floats:
    """(B, K) the x >= 0 that minimise |M x - t|^2 + ridge^2 |x|^2 for each of B systems.

    Args:
        matrix: (B, K, R) columns of M.
        target: (R,) t.
        ridge: weight of x itself, above 0.
        count: (B,) columns of each system that are used; x is 0 for the others.
    """
    shape = matrix.shape
    if not shape[0]:
        return np.zeros(shape[:2])
    with wp.ScopedDevice("cpu"):
        work = kernels.Workspace()
        work.normal, work.factor = (wp.empty((shape[0], shape[2], shape[2]), dtype=wp.float64) for _ in range(2))
        work.residual, work.wanted = (wp.empty((shape[0], shape[2]), dtype=wp.float64) for _ in range(2))
        work.used = wp.empty(shape[:2], dtype=wp.int32)
        x = wp.empty(shape[:2], dtype=wp.float64)
        sound = wp.empty(shape[0], dtype=wp.int32)
        wp.launch(
            kernels.nonnegative,
            shape[0],
            inputs=[
                wp.array(matrix, dtype=wp.float64), wp.array(target, dtype=wp.float64), wp.float64(ridge),
                wp.array(count, dtype=wp.int32),
            ],
            outputs=[work, x, sound],
        )  # fmt: skip
    found: Floats = np.array(x.numpy())
    for b in np.flatnonzero(sound.numpy() == 0):
        found[b] = _plain(matrix[b], target, ridge, int(count[b]))
    return found


def _plain(matrix: Floats, target: Floats, ridge: float, count: int) -> Floats:
    """One system by SciPy, the ridge as rows of its own."""
    system = np.vstack([matrix[:count].T, ridge * np.eye(count)])
    out = np.zeros(len(matrix))
    out[:count] = nnls(system, np.concatenate([target, np.zeros(count)]))[0]
    return out
