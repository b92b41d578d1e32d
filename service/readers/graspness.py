"""Graspness: how good a place a point of the object is to be grasped at."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from service.model.errors import InputError

Floats = NDArray[np.float64]

#: The hand touches a point when its surface is at most this far from it [m]: the middle contact threshold of shards.
TOUCH_M: Final = 0.005


def graspness(points: NDArray[Any], hands: NDArray[Any], *, touch_m: float = TOUCH_M) -> Floats:
    """Share of the grasps whose hand touches a point.

    Wang et al. 2021 (Graspness Discovery in Clutters, eq. 1) count, of a parallel gripper's poses laid out around each
    point, those that hold and are clear. A hand with fingers touches in several places, and its grasps are found, not
    laid out: of the valid grasps of a scene, those count for a point that touch it.

    Args:
        points: (P, 3) in the object's frame [m].
        hands: (K, H, 3) points on the surface of the hand in each grasp, in the same frame [m].
        touch_m: largest distance of a touch [m]. It should be more than half the distance of the hand's points.

    Returns:
        (P,) between 0 and 1; 0 where there are no grasps.

    Raises:
        InputError: SciPy is absent.
    """
    try:
        from scipy.spatial import cKDTree
    except ModuleNotFoundError:
        raise InputError("graspness needs SciPy; install it: pip install 'graspd[worker]'") from None

    found = np.zeros(len(points))
    if len(hands) == 0 or len(points) == 0:
        return found
    tree = cKDTree(points)
    for hand in hands:
        near = hand[(hand >= points.min(axis=0) - touch_m).all(1) & (hand <= points.max(axis=0) + touch_m).all(1)]
        if len(near):
            touched = tree.query_ball_point(near, touch_m)
            found[np.unique(np.concatenate(touched).astype(np.intp))] += 1
    return found / len(hands)
