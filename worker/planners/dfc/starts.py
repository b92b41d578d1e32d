"""DexGraspNet's starts: around the convex hull, the palm looks at it from some way off, joints near the pre-shape."""

from __future__ import annotations

from typing import Final

import numpy as np

from service.model.transforms import quat_from_axis_angle, quat_from_matrix, quat_multiply
from worker.hands.model import HandModel
from worker.objects.distance import sample_faces
from worker.objects.model import ObjectModel
from worker.simulation.state import HandState

#: Distance of the palm from the hull [m]: the source puts the root, which is a palm's length behind, at 0.2 to 0.3.
DISTANCE: Final = (0.1, 0.2)
#: Tilt of the approach away from the hull's normal [rad], at most.
TILT: Final = np.pi / 6
#: Standard deviation of joints about the pre-shape, as a share of their range.
POSTURE: Final = 0.1


def sample_starts(hand: HandModel, obj: ObjectModel, *, seed: int, batch: int, indices: range) -> HandState:
    """One start for each grasp; each depends on its own index only."""
    rows = [_start(hand, obj, np.random.default_rng([seed, batch, index])) for index in indices]
    return HandState(*(np.stack([row[k] for row in rows]) for k in range(3)))


def _start(hand: HandModel, obj: ObjectModel, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    points, faces = sample_faces(obj.hull_vertices, obj.hull_faces.astype(np.int64), 1, seed=int(rng.integers(2**31)))
    a, b, c = obj.hull_vertices[obj.hull_faces[faces[0]]]
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal)
    side = np.cross(normal, rng.normal(size=3))
    axis, angle = side / np.linalg.norm(side), rng.uniform(0.0, TILT)
    normal = normal * np.cos(angle) + np.cross(axis, normal) * np.sin(angle)
    align = _frame(-normal) @ _frame(hand.palm.approach).T
    roll = quat_from_axis_angle(-normal, np.array(rng.uniform(0.0, 2 * np.pi)))
    span = hand.upper - hand.lower
    q = np.clip(hand.preshape + POSTURE * span * rng.normal(size=hand.dofs), hand.lower, hand.upper)
    pivot = points[0] + rng.uniform(*DISTANCE) * normal - obj.centre_of_mass
    return pivot, quat_multiply(roll, quat_from_matrix(align)), q


def _frame(z: np.ndarray) -> np.ndarray:
    x = np.cross(np.eye(3)[int(np.argmin(np.abs(z)))], z)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])
