"""The obstacles of scenes, and the hand's features that must stay clear of them, on a Warp device."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import warp as wp
from numpy.typing import NDArray

from service.model.transforms import quat_rotate
from worker.grasps import Posture
from worker.hands.kinematics import body_poses
from worker.hands.model import HandModel
from worker.simulation.kernels import obstacles as kernels
from worker.simulation.surroundings import Obstacle, Surroundings

Floats = NDArray[np.float64]

#: Distance that a hand keeps from obstacles [m]: twice what a scene's certificate asks, for the way is swept in steps.
MARGIN_M: Final = 0.004
_ENDLESS: Final = 1e9


@dataclass(frozen=True)
class PosedFeatures:
    """The F features of a hand in P postures."""

    centre: Floats
    """(P, F, 3)"""
    axis: Floats
    """(P, F, 3); zero: a ball."""
    radius: Floats
    """(F,)"""
    rim: NDArray[np.bool_]
    """(F,)"""

    @classmethod
    def of(cls, hand: HandModel, postures: Posture) -> PosedFeatures:
        """The features of a hand in these postures."""
        features = hand.features
        bodies = body_poses(hand, postures.hand_pose, postures.joint_positions)[:, features.body]
        centre = quat_rotate(bodies[..., 3:], features.centre) + bodies[..., :3]
        axis = quat_rotate(bodies[..., 3:], features.axis)
        return cls(centre, axis, features.radius, (features.axis**2).sum(axis=1) > 0.5)

    def distance(self, obstacle: Obstacle) -> Floats:
        """(P, F) signed distance from an obstacle [m]: exact over a half-space, beyond edges a lower bound."""
        normal, offset = obstacle.planes[:, :3], obstacle.planes[:, 3]
        sine = np.sqrt(np.maximum(0.0, 1.0 - (self.axis @ normal.T) ** 2))
        reach = self.radius[:, None] * np.where(self.rim[:, None], sine, 1.0)
        return np.asarray((self.centre @ normal.T - offset - reach).max(axis=-1))


def feature_distances(hand: HandModel, postures: Posture, scene: Surroundings) -> Floats:
    """(P, F) signed distance of each of the hand's features from the nearest obstacle [m]; inf where there is none.

    Against half-spaces it is exact, beyond the edges of others a lower bound.
    """
    posed = PosedFeatures.of(hand, postures)
    least = np.full(posed.centre.shape[:2], np.inf)
    for obstacle in scene.obstacles:
        least = np.minimum(least, posed.distance(obstacle))
    return least


def obstacle_distances(hand: HandModel, postures: Posture, scene: Surroundings) -> Floats:
    """(P,) least of the `feature_distances` of each posture [m]."""
    return np.asarray(feature_distances(hand, postures, scene).min(axis=1))


@dataclass(frozen=True)
class DeviceObstacles:
    """Obstacles of S scenes, origin at the object's centre of mass, and the features of one hand."""

    features: Any
    solids: Any
    count: int
    """Features."""

    @classmethod
    def create(
        cls,
        hand: HandModel,
        scenes: Sequence[Surroundings],
        centre: Floats,
        device: str,
        *,
        margin: float | Floats = MARGIN_M,
    ) -> DeviceObstacles:
        """Upload obstacles.

        Args:
            hand: the hand.
            scenes: what stands around the object in each scene, object frame.
            centre: (3,) the object's centre of mass, object frame.
            device: Warp device.
            margin: distance to keep [m], of all features or (L,) of each body.
        """
        found = hand.features
        kept = np.broadcast_to(np.asarray(margin, float), hand.bodies)[found.body]
        obstacles = [o for scene in scenes for o in scene.obstacles]
        planes = np.concatenate([np.zeros((0, 4)), *(o.planes for o in obstacles)])
        planes[:, 3] -= planes[:, :3] @ centre
        with wp.ScopedDevice(device):
            features = kernels.Features()
            features.body = wp.array(found.body, dtype=wp.int32)
            features.centre = wp.array(found.centre, dtype=wp.vec3)
            features.axis = wp.array(found.axis, dtype=wp.vec3)
            features.radius = wp.array(found.radius, dtype=wp.float32)
            features.margin = wp.array(kept, dtype=wp.float32)
            features.weight = wp.ones(len(found), dtype=wp.float32)
            solids = kernels.Obstacles()
            solids.first = wp.array(_starts([len(s.obstacles) for s in scenes]), dtype=wp.int32)
            solids.first_plane = wp.array(_starts([len(o.planes) for o in obstacles]), dtype=wp.int32)
            solids.planes = wp.array(planes, dtype=wp.vec4)
            spheres = [_sphere(o.corners - centre) for o in obstacles]
            solids.centre = wp.array(np.array([s[0] for s in spheres]).reshape(-1, 3), dtype=wp.vec3)
            solids.radius = wp.array(np.array([s[1] for s in spheres]), dtype=wp.float32)
        return cls(features, solids, len(found))


def _starts(lengths: Sequence[int]) -> NDArray[np.int32]:
    return np.concatenate([[0], np.cumsum(lengths)]).astype(np.int32)


def _sphere(corners: Floats) -> tuple[Floats, float]:
    """A bounding sphere; of a body without corners, one without end."""
    if not len(corners):
        return np.zeros(3), _ENDLESS
    centre = (corners.min(axis=0) + corners.max(axis=0)) / 2
    return centre, float(np.linalg.norm(corners - centre, axis=1).max())
