"""Depth of penetration between hand and object."""

from __future__ import annotations

import numpy as np

from service.model.transforms import Floats
from worker.quality.probe import Distances


def penetration_depth(found: Distances) -> Floats:
    """(B,) deepest penetration, asked from both sides: hand points in the object, object points in the hand [m].

    One side alone is blind: a thin wall passes between hand points, a small fingertip between object points.
    """
    hand_in_object = np.maximum(0.0, -found.distance).max(axis=1)
    object_in_hand = np.maximum(0.0, -found.piece_distance).max(axis=1)
    deepest: Floats = np.maximum(hand_in_object, object_in_hand)
    return deepest
