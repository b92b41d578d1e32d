"""Bodies of a hand that touch at rest, and are therefore exempt from self-collision."""

import itertools

import numpy as np

from graspd.service.model.transforms import IDENTITY_POSE, Floats, apply
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.disk_cache import cached_step

#: Pieces closer than this [m] at rest count as touching.
TOUCH_M = 1e-4


def collision_exempt_pairs(hand: HandModel) -> frozenset[tuple[int, int]]:
    """Return pairs of bodies (a < b): parent or grandparent and child, and those that touch at rest.
    Rest means both the pre-shape and the middle of the limits: bodies that touch in both cannot be separated."""
    near = {(above, body) for body in range(1, hand.bodies) for above in [*hand.chain(body), 0][1:3]}
    open_, middle = (touching_bodies(hand, q, TOUCH_M) for q in (hand.preshape, (hand.lower + hand.upper) / 2))
    return frozenset(near | (open_ & middle))


def touching_bodies(hand: HandModel, q: Floats, margin: float) -> set[tuple[int, int]]:
    """Return pairs of bodies (a < b) with pieces closer than `margin` [m] at posture q (D,)."""
    poses = body_poses(hand, IDENTITY_POSE, hand.expand(q))[0]
    corners = [apply(poses[piece.body], piece.vertices) for piece in hand.pieces]
    boxes = [(c.min(axis=0) - margin, c.max(axis=0) + margin) for c in corners]
    found: set[tuple[int, int]] = set()
    for i, j in itertools.combinations(range(len(corners)), 2):
        a, b = sorted((hand.pieces[i].body, hand.pieces[j].body))
        if a == b or (a, b) in found or (boxes[i][0] > boxes[j][1]).any() or (boxes[j][0] > boxes[i][1]).any():
            continue
        if hull_distance(corners[i], corners[j]) < margin:
            found.add((a, b))
    return found


def hull_distance(a: Floats, b: Floats) -> float:
    """Compute the distance [m] of the convex hulls of two point sets (N, 3) and (M, 3); 0 if they overlap.
    Least squares over convex weights x, y: min |a'x - b'y|; rows of large weight keep sum x = sum y = 1."""
    return float(cached_step("distance", [a, b], lambda: [_hull_distance(a, b)])["0"])


def _hull_distance(a: Floats, b: Floats) -> Floats:
    from scipy.optimize import nnls  # slow to load

    scale = max(float(np.ptp(a, axis=0).max()), float(np.ptp(b, axis=0).max()))
    middle = a.mean(axis=0)
    weight = 1e3
    rows = np.zeros((5, len(a) + len(b)))
    rows[:3] = np.concatenate([a - middle, -(b - middle)]).T / scale
    rows[3, : len(a)] = rows[4, len(a) :] = weight
    solution, _ = nnls(rows, np.array([0, 0, 0, weight, weight]), maxiter=20 * rows.shape[1])
    return np.asarray(np.linalg.norm(rows[:3] @ solution) * scale)
