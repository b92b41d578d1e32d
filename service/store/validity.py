"""How the grasps of a base shard stand: valid, sound but judged by nobody, or neither.

*Sound*: passed the geometric gate. *Valid*: sound, and a referee judged that it holds. In a shard that nobody judged no
grasp is valid, whatever its column `quality/valid` says: graspd 0.1 wrote there which were sound.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

#: The columns of a base shard that tell; the first one always exists.
COLUMNS: Final = ("quality/valid", "quality/sound", "quality/success")


def judged(columns: Mapping[str, NDArray[Any]]) -> NDArray[np.bool_]:
    """(N,) whether a referee judged the grasp."""
    if "quality/success" not in columns:
        return np.zeros(len(columns["quality/valid"]), bool)
    return np.asarray(columns["quality/success"]) >= 0


def valid(columns: Mapping[str, NDArray[Any]]) -> NDArray[np.bool_]:
    """(N,) whether the grasp is valid."""
    return (np.asarray(columns["quality/valid"]) == 1) & judged(columns)


def sound(columns: Mapping[str, NDArray[Any]]) -> NDArray[np.bool_]:
    """(N,) whether the grasp passed the geometric gate, as far as the shard tells; a valid one did."""
    return np.asarray(columns.get("quality/sound", columns["quality/valid"])) == 1


def chosen(columns: Mapping[str, NDArray[Any]], *, unjudged: bool = False) -> NDArray[np.bool_]:
    """(N,) the valid grasps; with `unjudged` instead those that are sound and judged by nobody."""
    return sound(columns) & ~judged(columns) if unjudged else valid(columns)
