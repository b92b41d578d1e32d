"""Diversity of a set of grasps: variance (DexGraspBench), near-duplicates, and directions of approach in cells of
equal area."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.metrics import BANDS, SECTORS
from graspd.service.model.transforms import Floats, apply, quat_rotate
from graspd.worker.grasps import Posture
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.surface import sample_surface

#: Points of the hand's surface by which two postures are compared, spread evenly over it.
POINTS: Final = 64
#: Pairs of grasps that are compared at a time.
_PAIRS: Final = 4096
#: Grasps of which all pairs are looked at: SciPy, whose tree finds the near ones of many, is slow to load.
FEW: Final = 256


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


def hand_points(hand: HandModel, posture: Posture) -> Floats:
    """(N, P, 3) where the same `POINTS` points of the hand's surface are in N postures, object frame [m].

    The distance of two grasps is the mean distance of these points: a metric over the hand's pose and joints together,
    in metres, in which a joint counts by what it moves. What an object's symmetry makes alike is not alike here.
    """
    points = sample_surface(hand, POINTS)
    poses = body_poses(hand, posture.hand_pose, posture.joint_positions)
    return np.asarray(apply(poses[:, points.body], points.position))


def distances(points: Floats, one: NDArray[np.intp], other: NDArray[np.intp]) -> Floats:
    """(K,) distance of the grasps `one` from `other` (K,), rows of what `hand_points` gives [m]."""
    parts = [slice(i, i + _PAIRS) for i in range(0, len(one), _PAIRS)]
    found = [np.linalg.norm(points[one[part]] - points[other[part]], axis=2).mean(axis=1) for part in parts]
    return np.concatenate([np.zeros(0), *found])


def nearest(points: Floats) -> float | None:
    """Distance of the two grasps that are nearest to each other, of N (N, P, 3) [m]; None of fewer than two."""
    if len(points) < 2:
        return None
    from scipy.spatial import cKDTree

    middles = cKDTree(points.mean(axis=1))
    near = np.asarray(middles.query(middles.data, k=2)[1])
    rows = np.arange(len(points))
    # With twins of a middle the first neighbour need not be the point itself.
    bound = float(distances(points, rows, np.where(near[:, 0] == rows, near[:, 1], near[:, 0])).min())
    # The mean distance of points is at least the distance of their means.
    pairs = middles.query_pairs(bound, output_type="ndarray")
    return min(bound, *distances(points, pairs[:, 0], pairs[:, 1]).tolist()) if len(pairs) else bound


def distinct(points: Floats, least: float, *, given: int = 0) -> NDArray[np.bool_]:
    """(N,) grasps to keep so that no two are nearer than `least` [m]: each that is not near to one kept before it.

    Args:
        points: (N, P, 3) of `hand_points`.
        least: least distance; 0 keeps all.
        given: so many of the first are kept whatever is near them.
    """
    kept = np.ones(len(points), bool)
    if least <= 0 or len(points) < 2:
        return kept
    # The mean distance of points is at least the distance of their means.
    pairs = _near(points.mean(axis=1), least)
    near = pairs[distances(points, pairs[:, 0], pairs[:, 1]) < least]
    near = near[near[:, 1] >= given]
    for first, second in near[np.lexsort((near[:, 0], near[:, 1]))].tolist():
        if kept[first]:
            kept[second] = False
    return kept


def _near(places: Floats, reach: float) -> NDArray[np.intp]:
    """(K, 2) pairs of places (N, 3), the lower number first, that are no farther apart than `reach` [m]."""
    if len(places) > FEW:
        from scipy.spatial import cKDTree

        return np.asarray(cKDTree(places).query_pairs(reach, output_type="ndarray"), np.intp)
    one, other = np.triu_indices(len(places), 1)
    near = np.linalg.norm(places[one] - places[other], axis=1) <= reach
    return np.stack([one[near], other[near]], axis=1)


def _rotation_vector(quaternion: Floats) -> Floats:
    q = np.where(quaternion[:, :1] < 0, -quaternion, quaternion)
    sine = np.linalg.norm(q[:, 1:], axis=1)
    angle = 2 * np.arctan2(sine, q[:, 0])
    return q[:, 1:] * (angle / np.maximum(sine, 1e-12))[:, None]


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
