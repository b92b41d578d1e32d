"""Whether a hand can hold anything: some two of its surfaces must face each other and come closer."""

from __future__ import annotations

from typing import Final

import numpy as np

from service.model.transforms import IDENTITY_POSE, Floats, quat_rotate
from worker.hands.guess import posture
from worker.hands.kinematics import body_poses
from worker.hands.model import HandModel
from worker.hands.surface import sample_surface

_POINTS: Final = 512
_RANDOM: Final = 11
#: Surfaces farther apart than this hold nothing that a hand can lift, nearer than this nothing at all [m].
_GAP_M: Final = (0.004, 0.3)
#: Least cosine between a normal and the way to the other surface: within 60 degrees.
_FACING: Final = 0.5
#: A gap that changes less than this is that of a rigid fork [m].
_CLOSING_M: Final = 0.003


def opposes(hand: HandModel) -> bool:
    """Whether two points on different bodies face each other in some posture, with a gap that the joints change."""
    points = sample_surface(hand, _POINTS)
    rng = np.random.default_rng(0)
    shares = [posture(hand, share) for share in np.linspace(0, 1, 5)]
    q = np.concatenate([shares, rng.uniform(hand.lower, hand.upper, (_RANDOM, hand.dofs))])
    poses = body_poses(hand, np.tile(IDENTITY_POSE, (len(q), 1)), hand.expand(q))[:, points.body]
    position = quat_rotate(poses[..., 3:], points.position) + poses[..., :3]
    normal = quat_rotate(poses[..., 3:], points.normal)
    apart = points.body[:, None] != points.body[None]
    gaps = np.linalg.norm(position[0][:, None] - position[0][None], axis=2)
    least, most = gaps.copy(), gaps.copy()
    facing = np.zeros_like(apart)
    for at, outward in zip(position, normal, strict=True):
        found, gaps = _facing(at, outward)
        facing |= found & apart
        np.minimum(least, gaps, out=least)
        np.maximum(most, gaps, out=most)
    return bool((facing & (most - least > _CLOSING_M)).any())


def _facing(position: Floats, normal: Floats) -> tuple[np.ndarray, Floats]:
    """(N, N) whether two points look at each other over a gap, and the gap [m]."""
    way = position[None] - position[:, None]
    gap = np.linalg.norm(way, axis=2)
    toward = np.einsum("ijk,ik->ij", way, normal) > _FACING * gap
    return toward & toward.T & (gap > _GAP_M[0]) & (gap < _GAP_M[1]), gap
