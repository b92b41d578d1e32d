"""From where hands come: directions on the sphere in cells of equal area."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.model.metrics import BANDS, SECTORS
from service.model.transforms import quat_rotate
from worker.hands.model import HandModel


def approach_cells(hand: HandModel, quaternions: NDArray[np.float64]) -> NDArray[np.int32]:
    """(B,) cell from which the palm comes in B grasps, of which the root's quaternions (B, 4) are given."""
    return cells_of(-quat_rotate(quaternions, hand.palm.approach)).astype(np.int32)


def cells_of(directions: NDArray[Any], bands: int = BANDS, sectors: int = SECTORS) -> NDArray[np.int64]:
    """(N,) cell of unit vectors (N, 3): band times `sectors` plus sector; band 0 is the lowest, sector 0 begins at
    azimuth -180 degrees."""
    z = np.clip(directions[:, 2], -1.0, 1.0)
    azimuth = np.arctan2(directions[:, 1], directions[:, 0])
    band = np.minimum((bands * (z + 1) / 2).astype(np.int64), bands - 1)
    sector = np.minimum((sectors * (azimuth + np.pi) / (2 * np.pi)).astype(np.int64), sectors - 1)
    return np.asarray(band * sectors + sector)
