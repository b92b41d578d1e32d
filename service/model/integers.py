"""Arrays of integers."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def distinct_values(values: NDArray[np.integer[Any]]) -> list[int]:
    """Return the distinct values, ascending; NumPy's own `unique` would import its masked arrays."""
    return sorted(set(values.ravel().tolist()))
