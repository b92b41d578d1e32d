"""From where hands come: directions on the sphere in cells of equal area, and elevations over the table."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from service.model.diversity import BANDS, CELLS, SECTORS
from worker.quality.approach import cells_of

#: Fewer grasps leave cells empty by chance: with this many uniform ones e^-5 of a cell, 0.3 of all 48.
ENOUGH: Final = 5 * CELLS
#: Elevations from -90 to 90 degrees.
ELEVATION_BINS: Final = 36


def cell_counts(directions: NDArray[Any], bands: int = BANDS, sectors: int = SECTORS) -> NDArray[np.int64]:
    """(bands, sectors) how many unit vectors (N, 3) point into each cell; band 0 is the lowest, sector 0 begins at
    azimuth -180 degrees."""
    cells = cells_of(np.asarray(directions).reshape(-1, 3), bands, sectors)
    return np.bincount(cells, minlength=bands * sectors).reshape(bands, sectors)


def elevations(directions: NDArray[Any]) -> NDArray[np.int64]:
    """(ELEVATION_BINS,) unit vectors (N, 3) by their angle over the horizontal."""
    degrees = np.degrees(np.arcsin(np.clip(directions[:, 2], -1.0, 1.0)))
    return np.histogram(degrees, bins=ELEVATION_BINS, range=(-90, 90))[0].astype(np.int64)
