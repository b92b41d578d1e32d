"""Graspness as in DexGraspNet 2.0: distance-weighted number of grasps that aim at a point.

Zhang et al., DexGraspNet 2.0, CoRL 2024. The values follow their src/preprocess/dex_graspness.py, the clouds their
src/utils/pc.py, both as in zcyqyq/DexTouch-sim2real at 7824d859a8da1d942bc38709a9d217dfb548db5d. An object is 1,000
points of its surface:

    grasp g aims from the palm at the middle between its thumb and its other fingers
    seen    points ahead within 30 degrees of that line, at most 20 mm farther along it than the first of them
    p_g     the seen point with the least angle / 10 degrees + height / 15 mm
    value   of a point: the sum over all grasps of 10^(-150 d), d its distance from p_g [m]; no share and
        no logarithm: their loader computes the logarithm of value + 0.001
    pixel   on the object: the value of the nearest point; elsewhere 0

Theirs uses thumb and middle finger of a LEAP hand and the centre of its palm's box; here it is any hand's thumb, the
mean of its other fingertips, and the palm's surface. If no point is seen, theirs stops; here the point nearest to the
palm counts. For the nearest point theirs documents 15 mm but compares 0.015 with a squared distance, which pytorch3d's
`knn_points` returns. The actual 122 mm are used here.

`service.readers.clouds.graspness` differs: it is the share of grasps whose hand touches a point.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from graspd.service.model.transforms import IDENTITY_POSE, Floats, apply, invert, quat_rotate
from graspd.worker.grasps import Posture
from graspd.worker.hands.jaws import fingertip_pad
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.surface import OVERSAMPLING, farthest_points
from graspd.worker.objects.distance import sample_faces
from graspd.worker.objects.model import ObjectModel

SAMPLES: Final = 1000
#: Half the opening of a grasp's view cone [rad], and its depth beyond the first point [m].
CONE: Final = np.pi / 6
BAND_M: Final = 0.02
#: Angle [rad] and height beyond the first point [m] that halve the weight of a seen point.
ANGLE_HALF: Final = np.pi / 18
HEIGHT_HALF_M: Final = 0.015
#: Powers of ten by which a grasp's weight falls per metre from its aim point.
FALL_PER_M: Final = 150.0
#: Largest distance of a pixel from the point whose value it takes [m].
REACH_M: Final = 0.015**0.5
#: Points farther from the box around all objects are not in the cloud [m].
OUTLIER_M: Final = 0.02
#: Grasps that are evaluated at once: some 6 MB per array.
_AT_ONCE: Final = 256


def surface_samples(obj: ObjectModel) -> Floats:
    """Sample (`SAMPLES`, 3) even surface points of an object, in its frame [m]; equal for equal objects."""
    many = sample_faces(obj.vertices, obj.faces.astype(np.int64), OVERSAMPLING * SAMPLES)[0]
    return many[farthest_points(many, SAMPLES)]


@dataclass(frozen=True)
class SceneGraspness:
    """Graspness of one scene's object, from all its grasps there."""

    samples: Floats
    """(S, 3) points of the object's surface, in its frame [m]."""
    pointed: NDArray[np.intp]
    """(K,) index of the point that each grasp aims at."""
    values: Floats
    """(S,) graspness of the points, between 0 and K."""

    @classmethod
    def of(cls, hand: HandModel, grasps: Posture, samples: Floats) -> SceneGraspness:
        """Compute it from K grasps in the object's frame; without grasps all values are 0."""
        pointed = pointed_at(*lines_of_sight(hand, grasps), samples)
        return cls(samples, pointed, summed(samples, pointed))

    def of_view(
        self, depth: Floats, labels: NDArray[np.uint8], intrinsics: Floats, camera: Floats, object_pose: Floats
    ) -> NDArray[np.float32]:
        """Return the graspness (N, 1) of the loader's cloud of a picture, row by row; 0 on neighbours.

        `depth` (H, W) is 0 where nothing is [m]; `labels` (H, W) are 0 for background, 1 for the object of the grasps,
        at least one pixel; `intrinsics` (3, 3) [px]; `camera` (4, 4) is in the table's frame, `object_pose` (7,) in it.
        """
        cloud = back_projected(depth, intrinsics)
        inside = in_workspace(cloud, depth, labels, camera)
        found = np.zeros(np.count_nonzero(inside), np.float32)
        mine = labels[inside] == 1
        points = apply(invert(object_pose), cloud[inside][mine])
        # A point without a neighbour within reach gets an index past the last one.
        nearest = cKDTree(self.samples).query(points, distance_upper_bound=REACH_M)[1]
        found[mine] = np.append(self.values, 0)[nearest]
        return found[:, None]


def lines_of_sight(hand: HandModel, grasps: Posture) -> tuple[Floats, Floats]:
    """Return origins (K, 3) and unit directions (K, 3) of K grasps' lines of sight, in their frame [m].

    The thumb is the fingertip that is on average farthest from the others before the hand closes. For hands with one
    fingertip, or with fingers that meet in the palm, the line is the approach.
    """
    palm = apply(grasps.hand_pose, hand.palm.centre)
    line = quat_rotate(grasps.hand_pose[:, 3:], hand.palm.approach)
    if len(hand.fingertips) < 2:
        return palm, line
    open_ = _fingertips(hand, Posture(IDENTITY_POSE[None], hand.expand(hand.preshape)[None]))[0]
    thumb = int(cdist(open_, open_).sum(axis=1).argmax())
    tips = _fingertips(hand, grasps)
    middle = 0.5 * (tips[:, thumb] + np.delete(tips, thumb, axis=1).mean(axis=1))
    length = np.linalg.norm(middle - palm, axis=1, keepdims=True)
    return palm, np.where(length > 1e-6, (middle - palm) / np.maximum(length, 1e-6), line)


def _fingertips(hand: HandModel, grasps: Posture) -> Floats:
    """Return (K, F, 3) contact points of the fingertips [m]."""
    pads = np.array([fingertip_pad(hand, tip).centre for tip in hand.fingertips])
    return apply(body_poses(hand, grasps.hand_pose, grasps.joint_positions)[:, list(hand.fingertips)], pads)


def pointed_at(palm: Floats, line: Floats, samples: Floats) -> NDArray[np.intp]:
    """Return (K,) aim points' indices in `samples` (S, 3), seen from `palm` along unit `line` (K, 3) [m]."""
    found = np.empty(len(palm), np.intp)
    for first in range(0, len(palm), _AT_ONCE):
        some = slice(first, first + _AT_ONCE)
        away = samples - palm[some, None]
        distance = np.linalg.norm(away, axis=2)
        height = np.einsum("ksi,ki->ks", away, line[some])
        angle = np.arccos(np.clip(height / np.maximum(distance, 1e-12), -1, 1))
        seen = (height > 0) & (angle < CONE)
        beyond = height - np.where(seen, height, np.inf).min(axis=1, keepdims=True)
        seen &= beyond < BAND_M
        cost = np.where(seen, angle / ANGLE_HALF + beyond / HEIGHT_HALF_M, np.inf)
        found[some] = np.where(seen.any(axis=1), cost.argmin(axis=1), distance.argmin(axis=1))
    return found


def summed(samples: Floats, pointed: NDArray[np.intp]) -> Floats:
    """Return (S,) graspness of points (S, 3) [m] from the aim points' indices (K,)."""
    count = np.bincount(pointed, minlength=len(samples))
    some = np.flatnonzero(count)
    # Sum per point, not per grasp: at most S x S numbers for any number of grasps.
    return np.asarray(10.0 ** (-FALL_PER_M * cdist(samples, samples[some])) @ count[some], float)


def back_projected(depth: Floats, intrinsics: Floats) -> Floats:
    """Return (H, W, 3) points of a picture in its camera [m], bit for bit as in the loader: their number must agree."""
    u, v = np.meshgrid(np.arange(depth.shape[1]), np.arange(depth.shape[0]))
    x = (u - intrinsics[0, 2]) * depth / intrinsics[0, 0]
    y = (v - intrinsics[1, 2]) * depth / intrinsics[1, 1]
    return np.stack([x, y, depth], axis=-1)


def in_workspace(cloud: Floats, depth: Floats, labels: NDArray[np.uint8], camera: Floats) -> NDArray[np.bool_]:
    """Return (H, W) pixels whose points (H, W, 3) the loader keeps.

    These have a depth and lie in the box around all labelled pixels, on the table. As in the loader, labelled pixels
    without depth extend the box, at the camera.
    """
    whole = np.concatenate([cloud.reshape(-1, 3), np.ones((depth.size, 1))], axis=1)
    there = np.einsum("ab,nb->na", camera, whole)[:, :3]
    objects = there[labels.reshape(-1) > 0]
    low, high = objects.min(axis=0) - OUTLIER_M, objects.max(axis=0) + OUTLIER_M
    inside = ((there > low) & (there < high)).all(axis=1)
    return np.asarray(inside.reshape(depth.shape) & (depth > 0))
