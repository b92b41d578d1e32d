"""Forces that balance, of many grasps at once: non-negative least squares on the CPU or a GPU."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from service.model.transforms import Floats
from worker.simulation.kernels import balance as kernels
from worker.simulation.launches import launch


def solved(matrix: Any, target: Floats, ridge: float, count: Any) -> Any:
    """(B, K) the x >= 0 that minimise |M x - t|^2 + ridge^2 |x|^2 for each of B systems, on their device.

    Args:
        matrix: (B, K, R) columns of M, a Warp array in double precision.
        target: (R,) t.
        ridge: weight of x itself, above 0.
        count: (B,) columns of each system that are used, a Warp array; x is 0 for the others.
    """
    (batch, columns, rows), device = matrix.shape, matrix.device
    with wp.ScopedDevice(device):
        work = kernels.Workspace()
        work.normal, work.factor = (wp.empty((batch, rows, rows), dtype=wp.float64) for _ in range(2))
        work.residual, work.wanted = (wp.empty((batch, rows), dtype=wp.float64) for _ in range(2))
        work.used = wp.empty((batch, columns), dtype=wp.int32)
        x = wp.empty((batch, columns), dtype=wp.float64)
        sound = wp.empty(batch, dtype=wp.int32)
        launch(
            kernels.nonnegative, batch,
            inputs=[matrix, wp.array(target, dtype=wp.float64), wp.float64(ridge), count], outputs=[work, x, sound],
        )  # fmt: skip
    unsolved = np.flatnonzero(sound.numpy() == 0)
    if len(unsolved):
        found, columns, used = x.numpy(), matrix.numpy(), count.numpy()
        for b in unsolved:
            found[b] = _plain(columns[b], target, ridge, int(used[b]))
        x.assign(found)
    return x


def nonnegative_weights(matrix: Floats, target: Floats, ridge: float, count: NDArray[np.integer[Any]]) -> Floats:
    """`solved` for systems that are in NumPy, on the CPU."""
    if not len(matrix):
        return np.zeros(matrix.shape[:2])
    with wp.ScopedDevice("cpu"):
        given = wp.array(matrix, dtype=wp.float64), wp.array(count, dtype=wp.int32)
    found: Floats = np.array(solved(given[0], target, ridge, given[1]).numpy())
    return found


def _plain(matrix: Floats, target: Floats, ridge: float, count: int) -> Floats:
    """One system by SciPy, the ridge as rows of its own."""
    from scipy.optimize import nnls

    system = np.vstack([matrix[:count].T, ridge * np.eye(count)])
    out = np.zeros(len(matrix))
    out[:count] = nnls(system, np.concatenate([target, np.zeros(count)]))[0]
    return out
