"""Obstacles of scenes, and the hand's features that must avoid them, on a Warp device."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import warp as wp
from numpy.typing import NDArray

from graspd.service.model.transforms import Floats, quat_rotate
from graspd.worker.grasps import Posture
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.primitives import HandFeatures
from graspd.worker.objects.memory_cache import cached_by_content
from graspd.worker.simulation.device import DeviceHand, bounding_ball, chain_of, posed_bodies, to_xyzw
from graspd.worker.simulation.environment import CLEAR_M, Environment, Obstacle
from graspd.worker.simulation.kernels import chain as chain_kernels
from graspd.worker.simulation.kernels import kinematics
from graspd.worker.simulation.kernels import obstacles as kernels
from graspd.worker.simulation.kernels import solids as solid_kernels
from graspd.worker.simulation.launches import launch

#: Clearance of hands from obstacles in planning [m]: twice a scene's requirement, since trajectories are sampled.
MARGIN_M: Final = 0.004
FAR_M: Final = 0.1  # distances from solids are capped at this [m]


@dataclass(frozen=True)
class PosedFeatures:
    """The F features of a hand in P postures."""

    centre: Floats  # (P, F, 3)
    axis: Floats  # (P, F, 3); zero for a ball
    radius: Floats  # (F,)
    rim: NDArray[np.bool_]  # (F,)

    @classmethod
    def create(cls, hand: HandModel, postures: Posture) -> PosedFeatures:
        features = hand.features
        bodies = body_poses(hand, postures.hand_pose, postures.joint_positions)[:, features.body]
        centre = quat_rotate(bodies[..., 3:], features.centre) + bodies[..., :3]
        axis = quat_rotate(bodies[..., 3:], features.axis)
        return cls(centre, axis, features.radius, (features.axis**2).sum(axis=1) > 0.5)

    def distance(self, obstacle: Obstacle) -> Floats:
        """Return signed distances (P, F) from an obstacle [m]: exact for half-spaces, else lower bounds."""
        normal, offset = obstacle.planes[:, :3], obstacle.planes[:, 3]
        sine = np.sqrt(np.maximum(0.0, 1.0 - (self.axis @ normal.T) ** 2))
        reach = self.radius[:, None] * np.where(self.rim[:, None], sine, 1.0)
        return np.asarray((self.centre @ normal.T - offset - reach).max(axis=-1))


def _solid_distances(hand: HandModel, postures: Posture, scene: Environment) -> Floats:
    """Return distances (P, L) of bodies from a scene's solids [m], in float32 (rounding: 3e-8 at 0.3 m)."""
    bodies = body_poses(hand, postures.hand_pose, postures.joint_positions)
    device = _device_hand(hand)
    obstacles = DeviceObstacles.create(hand, [scene], np.zeros(3), "cpu")
    with wp.ScopedDevice("cpu"):
        hands = kinematics.Hands()
        hands.body_p = wp.array(bodies[..., :3], dtype=wp.vec3)
        hands.body_q = wp.array(to_xyzw(bodies[..., 3:]), dtype=wp.quat)
        least = wp.full((len(bodies), hand.bodies), FAR_M, dtype=wp.float32)
        inputs = [obstacles.features, device.pieces, obstacles.solids, hands, FAR_M]
        launch(solid_kernels.distances, (len(bodies), len(hand.pieces)), inputs=inputs, outputs=[least], device="cpu")
    return least.numpy().astype(float)


@cached_by_content(8)
def _device_hand(hand: HandModel) -> DeviceHand:
    # Loading here prevents threads from compiling the same module at once.
    wp.load_module(module=solid_kernels, device="cpu")
    return DeviceHand.create(hand, "cpu")


def body_clearance(
    hand: HandModel, postures: Posture, scenes: Sequence[Environment], which: NDArray[np.integer[Any]] | None = None
) -> Floats:
    """Return signed distances (P, L) of the hand's bodies from the nearest obstacle [m]; inf if none.
    Posture i is in the scene `which[i]`, by default in the first one. A hand is clear if no distance is below
    `CLEAR_M`: where fingertips may be closer to a support, their distance is increased by the difference. Distances are
    exact from half-spaces, and from solids that the hand does not penetrate; near edges and corners of solids, those of
    links with hulls are lower bounds. Distances from solids are at most `FAR_M`."""
    which = np.zeros(len(postures), np.int32) if which is None else np.asarray(which, np.int32)
    every = [[o for o in scene.obstacles if not len(o.corners)] for scene in scenes]
    flat, count = [o for one in every for o in one], len(postures)
    bodies, spaces = posed_bodies(hand, postures.hand_pose, postures.joint_positions), chain_kernels.HalfSpaces()
    with wp.ScopedDevice("cpu"):
        spaces.first = wp.array(np.cumsum([0, *map(len, every)]), dtype=wp.int32)
        spaces.planes = wp.array(np.concatenate([np.zeros((0, 4)), *(o.planes for o in flat)]), dtype=wp.vec4d)
        spaces.more = wp.array([_extra_margin(o) for o in flat], dtype=wp.float64)
        room = wp.full((count, hand.bodies), np.inf, dtype=wp.float64)
        inputs = [chain_of(hand, "cpu"), spaces, wp.array(which, dtype=wp.int32), bodies.position, bodies.rotation]
        launch(chain_kernels.half_space_clearance, (count, hand.bodies), inputs=inputs, outputs=[room], device="cpu")
    out = np.asarray(room.numpy())
    tips = np.isin(np.arange(hand.bodies), hand.fingertips)
    for number, scene in enumerate(scenes):
        solids = [o for o in scene.obstacles if len(o.corners)]
        rows = np.flatnonzero(which == number) if solids else np.zeros(0, np.intp)
        for more in sorted({_extra_margin(o) for o in solids} if len(rows) else ()):
            alike = Environment(tuple(o for o in solids if _extra_margin(o) == more), scene.up)
            out[rows] = np.minimum(out[rows], _solid_distances(hand, postures.take(rows), alike) + more * tips)
    return out


def _extra_margin(obstacle: Obstacle) -> float:
    return 0.0 if obstacle.tips_m is None else CLEAR_M - obstacle.tips_m


def obstacle_clearance(
    hand: HandModel, postures: Posture, scenes: Sequence[Environment], which: NDArray[np.integer[Any]] | None = None
) -> Floats:
    """Return the least `body_clearance` (P,) of each posture [m]."""
    return np.asarray(body_clearance(hand, postures, scenes, which).min(axis=1))


@dataclass(frozen=True)
class DeviceObstacles:
    """Obstacles of S scenes, origin at the object's centre of mass, and the features of one hand."""

    features: Any
    solids: Any
    any_solid: bool  # whether any obstacle is not a half-space

    @classmethod
    def create(
        cls,
        hand: HandModel,
        scenes: Sequence[Environment],
        centre: Floats,
        device: str,
        *,
        margin: float | Floats = MARGIN_M,
    ) -> DeviceObstacles:
        """Upload obstacles in the object frame, in which `centre` (3,) is the centre of mass.
        `margin` is the clearance of features [m], or (L,) per body."""
        found = hand.features
        kept = np.broadcast_to(np.asarray(margin, float), hand.bodies)[found.body]
        sorted_ = [sorted(scene.obstacles, key=lambda o: len(o.corners) > 0) for scene in scenes]
        endless = [sum(not len(o.corners) for o in one) for one in sorted_]
        obstacles = [o for one in sorted_ for o in one]
        planes = np.concatenate([np.zeros((0, 4)), *(o.planes for o in obstacles)])
        planes[:, 3] -= planes[:, :3] @ centre
        with wp.ScopedDevice(device):
            features = kernels.Features()
            features.body = wp.array(found.body, dtype=wp.int32)
            features.centre = wp.array(found.centre, dtype=wp.vec3)
            features.axis = wp.array(found.axis, dtype=wp.vec3)
            features.radius = wp.array(found.radius, dtype=wp.float32)
            features.margin = wp.array(kept, dtype=wp.float32)
            features.tip = wp.array(np.isin(found.body, hand.fingertips), dtype=wp.int32)
            features.first = wp.array(found.first, dtype=wp.int32)
            balls = [_feature_ball(found, k) for k in range(len(found.first) - 1)]
            features.middle = wp.array(np.array([ball[0] for ball in balls]).reshape(-1, 3), dtype=wp.vec3)
            features.extent = wp.array([ball[1] for ball in balls], dtype=wp.float32)
            features.first_edge = wp.array(found.first_edge, dtype=wp.int32)
            features.start = wp.array(found.edges[:, 0], dtype=wp.vec3)
            features.end = wp.array(found.edges[:, 1], dtype=wp.vec3)
            features.thickness = wp.array(found.thickness, dtype=wp.float32)
            solids = kernels.Obstacles()
            first = np.cumsum([0, *map(len, sorted_)])
            solids.first = wp.array(first, dtype=wp.int32)
            solids.first_solid = wp.array(first[:-1] + np.array(endless, int), dtype=wp.int32)
            solids.first_plane = wp.array(np.cumsum([0, *(len(o.planes) for o in obstacles)]), dtype=wp.int32)
            solids.planes = wp.array(planes, dtype=wp.vec4)
            solids.tips = wp.array([FAR_M if o.tips_m is None else o.tips_m for o in obstacles], dtype=wp.float32)
            spheres = [bounding_ball(o.corners - centre) for o in obstacles]
            solids.centre = wp.array(np.array([s[0] for s in spheres]).reshape(-1, 3), dtype=wp.vec3)
            solids.radius = wp.array(np.array([s[1] for s in spheres]), dtype=wp.float32)
            edges = np.concatenate([np.zeros((0, 2, 3)), *(o.corners[o.edges] for o in obstacles)]) - centre
            solids.first_edge = wp.array(np.cumsum([0, *(len(o.edges) for o in obstacles)]), dtype=wp.int32)
            solids.start, solids.end = (wp.array(edges[:, k], dtype=wp.vec3) for k in (0, 1))
        return cls(features, solids, any(len(o.corners) for o in obstacles))


def _feature_ball(features: HandFeatures, piece: int) -> tuple[Floats, float]:
    """Return centre (body frame) and radius [m] of a ball around the features of a piece."""
    rows = slice(features.first[piece], features.first[piece + 1])
    middle, radius = bounding_ball(features.centre[rows])
    # Slightly larger, since kernels round.
    return middle, radius + float(features.radius[rows].max(initial=0.0)) + 1e-6
