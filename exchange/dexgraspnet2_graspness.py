"""Graspness as DexGraspNet 2.0 has it: how many grasps point at a place of an object, near ones counted by distance.

Zhang et al., DexGraspNet 2.0, CoRL 2024. The numbers are those of their src/preprocess/dex_graspness.py, of the cloud
that values belong to those of their src/utils/pc.py, both as zcyqyq/DexTouch-sim2real carries them at
7824d859a8da1d942bc38709a9d217dfb548db5d. An object is 1,000 points of its surface:

    grasp g looks from the palm to the middle between its thumb and its other fingers
    seen    points ahead within 30 degrees of that line, at most 20 mm farther along it than the first of them
    p_g     of the seen points the one with the least angle / 10 degrees + height / 15 mm
    value   of a point: the sum over all grasps of 10^(-150 d), d its distance from p_g [m]; neither a share nor a
            logarithm, which their loader takes itself, of value + 0.001
    pixel   of the object: the value of the nearest point; of all else 0

Theirs takes thumb and middle finger of a LEAP hand and the centre of its palm's box; here it is any hand's thumb and
the mean of its other fingertips, and the palm's surface. Where no point is seen theirs stops; here it is the point
nearest to the palm. Of the nearest point theirs says 15 mm and holds 0.015 against a squared distance, which is what
pytorch3d's `knn_points` returns: 122 mm is what it does, and what is taken here.

`service.readers.clouds.graspness` tells something else: the share of grasps whose hand touches a point.
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
#: Half the opening of the cone that a grasp looks into [rad], and how far beyond its first point it sees [m].
CONE: Final = np.pi / 6
BAND_M: Final = 0.02
#: What halves the weight of a seen point: its angle [rad], its height beyond the first one [m].
ANGLE_HALF: Final = np.pi / 18
HEIGHT_HALF_M: Final = 0.015
#: Powers of ten by which a grasp counts less, one metre from where it points.
FALL_PER_M: Final = 150.0
#: Farthest that a pixel may lie from the point whose value it takes [m].
REACH_M: Final = 0.015**0.5
#: What lies farther from the box around all objects is no part of the cloud [m].
OUTLIER_M: Final = 0.02
#: Grasps that are looked along at once: some 6 MB an array.
_AT_ONCE: Final = 256


def surface_samples(obj: ObjectModel) -> Floats:
    """(`SAMPLES`, 3) even points of an object's surface, in its frame [m]; the same for the same object."""
    many = sample_faces(obj.vertices, obj.faces.astype(np.int64), OVERSAMPLING * SAMPLES)[0]
    return many[farthest_points(many, SAMPLES)]


@dataclass(frozen=True)
class SceneGraspness:
    """Of the object of one scene, from all its grasps there."""

    samples: Floats
    """(S, 3) points of the object's surface, in its frame [m]."""
    pointed: NDArray[np.intp]
    """(K,) the point at which each grasp points."""
    values: Floats
    """(S,) graspness of the points, between 0 and K."""

    @classmethod
    def of(cls, hand: HandModel, grasps: Posture, samples: Floats) -> SceneGraspness:
        """From K grasps in the object's frame; without grasps all values are 0."""
        pointed = pointed_at(*lines_of_sight(hand, grasps), samples)
        return cls(samples, pointed, summed(samples, pointed))

    def of_view(
        self, depth: Floats, labels: NDArray[np.uint8], intrinsics: Floats, camera: Floats, object_pose: Floats
    ) -> NDArray[np.float32]:
        """Graspness of the cloud that the loader makes of a picture.

        Args:
            depth: (H, W) as the loader reads it [m]; 0: nothing.
            labels: (H, W) 0 background, 1 the object of the grasps, others its neighbours; some pixel has one.
            intrinsics: (3, 3) of a camera whose pixels are numbers [px].
            camera: (4, 4) its pose in the table's frame.
            object_pose: (7,) pose of the object in the camera.

        Returns:
            (N, 1) for the N points, row by row of the picture; a neighbour's is 0, for it has no grasps.
        """
        cloud = back_projected(depth, intrinsics)
        inside = in_workspace(cloud, depth, labels, camera)
        found = np.zeros(np.count_nonzero(inside), np.float32)
        mine = labels[inside] == 1
        points = apply(invert(object_pose), cloud[inside][mine])
        # A point without a neighbour within reach gets the number behind the last one.
        nearest = cKDTree(self.samples).query(points, distance_upper_bound=REACH_M)[1]
        found[mine] = np.append(self.values, 0)[nearest]
        return found[:, None]


def lines_of_sight(hand: HandModel, grasps: Posture) -> tuple[Floats, Floats]:
    """Where K grasps look from (K, 3) and whereto (K, 3), unit; in the frame of their poses [m].

    The thumb is the fingertip that is farthest from the others, on average, before the hand closes. A hand that has one
    fingertip, or whose fingers meet in its palm, looks along its approach.
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
    """(K, F, 3) where each fingertip presses [m]."""
    pads = np.array([fingertip_pad(hand, tip).centre for tip in hand.fingertips])
    return apply(body_poses(hand, grasps.hand_pose, grasps.joint_positions)[:, list(hand.fingertips)], pads)


def pointed_at(palm: Floats, line: Floats, samples: Floats) -> NDArray[np.intp]:
    """(K,) which of the points (S, 3) grasps point at that look from `palm` (K, 3) along `line` (K, 3), unit [m]."""
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
    """(S,) graspness of points (S, 3) [m], at which K grasps point by number (K,)."""
    count = np.bincount(pointed, minlength=len(samples))
    some = np.flatnonzero(count)
    # By point, not by grasp: at most S x S numbers, however many grasps there are.
    return np.asarray(10.0 ** (-FALL_PER_M * cdist(samples, samples[some])) @ count[some], float)


def back_projected(depth: Floats, intrinsics: Floats) -> Floats:
    """(H, W, 3) points of a picture in its camera [m]. Each sum is done as the loader does it, bit for bit: one point
    more or less at the edge of the workspace and all values behind it belong to other points."""
    u, v = np.meshgrid(np.arange(depth.shape[1]), np.arange(depth.shape[0]))
    x = (u - intrinsics[0, 2]) * depth / intrinsics[0, 0]
    y = (v - intrinsics[1, 2]) * depth / intrinsics[1, 1]
    return np.stack([x, y, depth], axis=-1)


def in_workspace(cloud: Floats, depth: Floats, labels: NDArray[np.uint8], camera: Floats) -> NDArray[np.bool_]:
    """(H, W) pixels whose points (H, W, 3) the loader takes: those that tell a depth, in the box around all that is
    labelled, on the table. Labelled pixels without depth count in the box, at the camera, as they do for the loader."""
    whole = np.concatenate([cloud.reshape(-1, 3), np.ones((depth.size, 1))], axis=1)
    there = np.einsum("ab,nb->na", camera, whole)[:, :3]
    objects = there[labels.reshape(-1) > 0]
    low, high = objects.min(axis=0) - OUTLIER_M, objects.max(axis=0) + OUTLIER_M
    inside = ((there > low) & (there < high)).all(axis=1)
    return np.asarray(inside.reshape(depth.shape) & (depth > 0))
