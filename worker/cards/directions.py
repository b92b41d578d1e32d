"""From where hands come: directions on the sphere in cells of equal area, and elevations over the table."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

#: Cells of equal area: bands of equal height z (Archimedes), each cut into equal azimuths.
BANDS: Final = 4
SECTORS: Final = 12
CELLS: Final = BANDS * SECTORS
#: Fewer grasps leave cells empty by chance: with this many uniform ones e^-5 of a cell, 0.3 of all 48.
ENOUGH: Final = 5 * CELLS
#: Elevations from -90 to 90 degrees.
ELEVATION_BINS: Final = 36


def cell_counts(directions: NDArray[Any], bands: int = BANDS, sectors: int = SECTORS) -> NDArray[np.int64]:
    """(bands, sectors) how many unit vectors (N, 3) point into each cell; band 0 is the lowest, sector 0 begins at
    azimuth -180 degrees."""
    if not len(directions):
        return np.zeros((bands, sectors), np.int64)
    z = np.clip(directions[:, 2], -1.0, 1.0)
    azimuth = np.arctan2(directions[:, 1], directions[:, 0])
    band = np.minimum((bands * (z + 1) / 2).astype(np.int64), bands - 1)
    sector = np.minimum((sectors * (azimuth + np.pi) / (2 * np.pi)).astype(np.int64), sectors - 1)
    return np.bincount(band * sectors + sector, minlength=bands * sectors).reshape(bands, sectors)


def evenness(counts: NDArray[np.int64]) -> float:
    """Cells that would be needed to spread as widely if each were used alike, over all cells: exp(entropy) / cells.

    1 is even; 1 / cells is all from one direction; 0 if there is none.
    """
    share = counts[counts > 0] / max(1, counts.sum())
    return float(np.exp(-(share * np.log(share)).sum()) / counts.size) if len(share) else 0.0


def elevations(directions: NDArray[Any]) -> NDArray[np.int64]:
    """(ELEVATION_BINS,) unit vectors (N, 3) by their angle over the horizontal."""
    degrees = np.degrees(np.arcsin(np.clip(directions[:, 2], -1.0, 1.0)))
    return np.histogram(degrees, bins=ELEVATION_BINS, range=(-90, 90))[0].astype(np.int64)
