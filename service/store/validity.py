"""Status of the grasps of a base shard: valid, feasible without validation, or neither.

*Feasible*: within the geometric limits. *Valid*: feasible, and held in validation. A shard without validation has no
valid grasps, even if its column `quality/valid` marks feasible grasps (graspd 0.1).
"""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

#: Columns of a base shard that decide the status; the first always exists.
COLUMNS: Final = ("quality/valid", "quality/feasible", "quality/success")


def validated_mask(columns: Mapping[str, NDArray[Any]]) -> NDArray[np.bool_]:
    if "quality/success" not in columns:
        return np.zeros(len(columns["quality/valid"]), bool)
    return np.asarray(columns["quality/success"]) >= 0


def valid_mask(columns: Mapping[str, NDArray[Any]]) -> NDArray[np.bool_]:
    return (np.asarray(columns["quality/valid"]) == 1) & validated_mask(columns)


def feasible_mask(columns: Mapping[str, NDArray[Any]]) -> NDArray[np.bool_]:
    """Return the mask (N,) of feasible grasps; without column `quality/feasible`, by `quality/valid`."""
    return np.asarray(columns.get("quality/feasible", columns["quality/valid"])) == 1


def second_engine_counts(columns: Mapping[str, NDArray[Any]]) -> dict[str, int]:
    """Count valid grasps that second engines tested, and those that all engines hold."""
    agreement = np.asarray(columns.get("quality/agreement", np.zeros(0)), float)
    known = agreement[valid_mask(columns)] if len(agreement) else agreement
    return {"second_tested": int(np.isfinite(known).sum()), "second_held": int((known == 1).sum())}


def selection_mask(columns: Mapping[str, NDArray[Any]], *, unvalidated: bool = False) -> NDArray[np.bool_]:
    """Return the mask (N,) of valid grasps, or of `unvalidated` feasible grasps."""
    return feasible_mask(columns) & ~validated_mask(columns) if unvalidated else valid_mask(columns)
