"""Diversity of a set of grasps: variance (DexGraspBench), near-duplicates, and approach cells."""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.metrics import BANDS, SECTORS
from graspd.service.model.transforms import Floats, apply, quat_rotate
from graspd.worker.grasps import Posture
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.surface import sample_surface

POINTS: Final = 64  # number of surface points of the hand for the comparison of two postures, spread evenly
_PAIRS: Final = 4096  # pairs of grasps compared at a time


def explained_variance(posture: Posture) -> Floats:
    """Compute the explained variance (K,) of translation, rotation vector and joints, largest share first.
    Entries are shares along the principal components; empty for fewer than 2 grasps. Diversity D is the first entry:
    near 1, all grasps vary along one line. Units stay metres and radians, as in DexGraspBench."""
    if len(posture) < 2:
        return np.zeros(0)
    translation, quaternion = posture.hand_pose[:, :3], posture.hand_pose[:, 3:]
    features = np.hstack([translation, _rotation_vector(quaternion), posture.joint_positions])
    variance = np.linalg.svd(features - features.mean(axis=0), compute_uv=False) ** 2
    total = float(variance.sum())
    return variance / total if total > 0 else np.zeros(len(variance))


def hand_points(hand: HandModel, posture: Posture) -> Floats:
    """Return the positions (N, P, 3) of the same `POINTS` surface points in N postures, object frame [m].
    The mean distance of these points is the distance of two grasps. Grasps that the object's symmetry makes equivalent
    count as different."""
    points = sample_surface(hand, POINTS)
    poses = body_poses(hand, posture.hand_pose, posture.joint_positions)
    return np.asarray(apply(poses[:, points.body], points.position))


def grasp_distances(points: Floats, one: NDArray[np.intp], other: NDArray[np.intp]) -> Floats:
    """Compute distances (K,) [m] between grasps `one` and `other`, (K,) indices into `points` (N, P, 3)."""
    parts = [slice(i, i + _PAIRS) for i in range(0, len(one), _PAIRS)]
    found = [np.linalg.norm(points[one[part]] - points[other[part]], axis=2).mean(axis=1) for part in parts]
    return np.concatenate([np.zeros(0), *found])


def least_distance(points: Floats) -> float | None:
    """Return the least distance between two of N grasps (N, P, 3) [m]; None for fewer than two."""
    if len(points) < 2:
        return None
    from scipy.spatial import cKDTree  # slow to import

    middles = cKDTree(points.mean(axis=1))
    near = np.asarray(middles.query(middles.data, k=2)[1])
    rows = np.arange(len(points))
    # If mean points coincide, the first neighbour may be a point other than the point itself.
    bound = float(grasp_distances(points, rows, np.where(near[:, 0] == rows, near[:, 1], near[:, 0])).min())
    # The mean distance of points is at least the distance of their means.
    pairs = middles.query_pairs(bound, output_type="ndarray")
    return min(bound, *grasp_distances(points, pairs[:, 0], pairs[:, 1]).tolist()) if len(pairs) else bound


def distinct_mask(points: Floats, least: float, *, given: int = 0) -> NDArray[np.bool_]:
    """Return a mask (N,) of grasps at least `least` [m] apart, by points (N, P, 3); all True if it is 0.
    Earlier grasps take precedence; the first `given` are always selected."""
    kept = np.ones(len(points), bool)
    if least <= 0 or len(points) < 2:
        return kept
    from scipy.spatial import cKDTree

    # The mean distance of points is at least the distance of their means.
    pairs = np.asarray(cKDTree(points.mean(axis=1)).query_pairs(least, output_type="ndarray"), np.intp)
    near = pairs[grasp_distances(points, pairs[:, 0], pairs[:, 1]) < least]
    near = near[near[:, 1] >= given]
    for first, second in near[np.lexsort((near[:, 0], near[:, 1]))].tolist():
        if kept[first]:
            kept[second] = False
    return kept


def select_farthest(points: Floats, count: int) -> NDArray[np.intp]:
    """Return rows (`count`,) of N grasps, by points (N, P, 3); all N rows if there are fewer.
    The first row is 0; each other grasp is the farthest from its nearest selected one, at equal distance the first."""
    rows, least = list[int](), np.full(len(points), np.inf)
    for _ in range(min(count, len(points))):
        rows.append(int(least.argmax()))
        least = np.minimum(least, grasp_distances(points, np.full(len(points), rows[-1]), np.arange(len(points))))
        least[rows] = -1.0
    return np.array(rows, np.intp)


def _rotation_vector(quaternion: Floats) -> Floats:
    q = np.where(quaternion[:, :1] < 0, -quaternion, quaternion)
    sine = np.linalg.norm(q[:, 1:], axis=1)
    angle = 2 * np.arctan2(sine, q[:, 0])
    return q[:, 1:] * (angle / np.maximum(sine, 1e-12))[:, None]


def approach_cells(hand: HandModel, quaternions: NDArray[np.float64]) -> NDArray[np.int32]:
    return direction_cells(-quat_rotate(quaternions, hand.palm.approach)).astype(np.int32)


def direction_cells(directions: NDArray[Any], bands: int = BANDS, sectors: int = SECTORS) -> NDArray[np.int64]:
    """Return the cells (N,) of unit vectors (N, 3): band times `sectors` plus sector.
    Band 0 is the lowest; sector 0 begins at azimuth -180 degrees."""
    z = np.clip(directions[:, 2], -1.0, 1.0)
    azimuth = np.arctan2(directions[:, 1], directions[:, 0])
    band = np.minimum((bands * (z + 1) / 2).astype(np.int64), bands - 1)
    sector = np.minimum((sectors * (azimuth + np.pi) / (2 * np.pi)).astype(np.int64), sectors - 1)
    return np.asarray(band * sectors + sector)
