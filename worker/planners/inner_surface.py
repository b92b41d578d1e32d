"""The inside of a hand: surface that moves ahead when the fingers close, and the palm."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from service.model.transforms import IDENTITY_POSE, Floats, apply, quat_rotate
from worker.hands.kinematics import body_poses
from worker.hands.model import HandModel, SurfacePoints
from worker.hands.surface import farthest_points, sample_surface

#: Inside: the surface moves along its normal to within 45 degrees when the fingers close; the palm looks ahead.
INSIDE_COS: Final = 0.7
SAMPLES: Final = 1200
STEP: Final = 1e-4


def inside_points(hand: HandModel, *, each: int, on_palm: int) -> SurfacePoints:
    """At most `each` points on every link that closes and `on_palm` on the palm, spread widely; none on other links."""
    points = sample_surface(hand, SAMPLES)
    inside = _inside(hand, points)
    chosen: list[NDArray[np.intp]] = []
    for body in range(hand.bodies):
        mine = np.flatnonzero((points.body == body) & inside)
        if len(mine):
            count = min(len(mine), each if body else on_palm)
            chosen.append(mine[farthest_points(points.position[mine], count)])
    index = np.sort(np.concatenate(chosen)) if chosen else np.zeros(0, np.intp)
    return SurfacePoints(points.body[index], points.position[index], points.normal[index], points.area[index])


def _inside(hand: HandModel, points: SurfacePoints) -> NDArray[np.bool_]:
    """(N,) whether a point lies on the inside of its link."""
    before, after = (_posed(hand, points, hand.preshape + t * hand.closing) for t in (0.0, STEP))
    motion = after[0] - before[0]
    speed = np.linalg.norm(motion, axis=1)
    along = np.einsum("ni,ni->n", motion, before[1]) / np.maximum(speed, 1e-12)
    ahead = before[1] @ hand.palm.approach
    return np.where(speed > 1e-3 * STEP, along > INSIDE_COS, (points.body == 0) & (ahead > INSIDE_COS))


def _posed(hand: HandModel, points: SurfacePoints, q: Floats) -> tuple[Floats, Floats]:
    pose = body_poses(hand, IDENTITY_POSE, hand.expand(q))[0][points.body]
    return apply(pose, points.position), quat_rotate(pose[:, 3:], points.normal)
