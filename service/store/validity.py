"""How the grasps of a base shard stand: valid, feasible but validated by nobody, or neither.

*Feasible*: passed the geometric gate. *Valid*: feasible, and a validator validated that it holds. In a shard that are
not validated no grasp is valid, whatever its column `quality/valid` says: graspd 0.1 wrote there which were feasible.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

#: The columns of a base shard that tell; the first one always exists.
COLUMNS: Final = ("quality/valid", "quality/feasible", "quality/success")


def validated(columns: Mapping[str, NDArray[Any]]) -> NDArray[np.bool_]:
    """(N,) whether a validator validated the grasp."""
    if "quality/success" not in columns:
        return np.zeros(len(columns["quality/valid"]), bool)
    return np.asarray(columns["quality/success"]) >= 0


def valid(columns: Mapping[str, NDArray[Any]]) -> NDArray[np.bool_]:
    """(N,) whether the grasp is valid."""
    return (np.asarray(columns["quality/valid"]) == 1) & validated(columns)


def feasible(columns: Mapping[str, NDArray[Any]]) -> NDArray[np.bool_]:
    """(N,) whether the grasp passed the geometric gate, as far as the shard tells; a valid one did."""
    return np.asarray(columns.get("quality/feasible", columns["quality/valid"])) == 1


def chosen(columns: Mapping[str, NDArray[Any]], *, unvalidated: bool = False) -> NDArray[np.bool_]:
    """(N,) the valid grasps; with `unvalidated` instead those that are feasible and validated by nobody."""
    return feasible(columns) & ~validated(columns) if unvalidated else valid(columns)
