"""How different the grasps of a set are (DexGraspBench)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from worker.grasps import Posture

Floats = NDArray[np.float64]


def explained_variance(posture: Posture) -> Floats:
    """Share of variance along each principal component of (translation, rotation vector, joints), largest first.

    Diversity D is the first entry: near 1 all grasps lie on a line of variants, lower is more diverse. Columns are
    taken as they are (metres and radians), as DexGraspBench does. Empty for fewer than 2 grasps.
    """
    if len(posture) < 2:
        return np.zeros(0)
    features = np.hstack(
        [posture.hand_pose[:, :3], _rotation_vector(posture.hand_pose[:, 3:]), posture.joint_positions]
    )
    singular = np.linalg.svd(features - features.mean(axis=0), compute_uv=False)
    variance = singular**2
    total = float(variance.sum())
    return variance / total if total > 0 else np.zeros(len(variance))


def _rotation_vector(quaternion: Floats) -> Floats:
    q = np.where(quaternion[:, :1] < 0, -quaternion, quaternion)
    sine = np.linalg.norm(q[:, 1:], axis=1)
    angle = 2 * np.arctan2(sine, q[:, 0])
    return q[:, 1:] * (angle / np.maximum(sine, 1e-12))[:, None]
