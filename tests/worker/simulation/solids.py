"""Distances between links and solid obstacles in float64, by golden sections along every edge."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from graspd.service.model.transforms import apply, invert
from graspd.worker.hands.model import ConvexPiece, HandModel
from graspd.worker.hands.surface import piece_distance
from graspd.worker.simulation.environment import Obstacle

_GOLDEN = (np.sqrt(5) - 1) / 2


def least_along(f: Callable[[np.ndarray], np.ndarray], edges: np.ndarray) -> np.ndarray:
    """(E,) least value of a convex function of points (E, 3) on edges (E, 2, 3)."""
    low, high = np.zeros((len(edges), 1)), np.ones((len(edges), 1))
    for _ in range(45):
        a, b = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
        left = (f(edges[:, 0] + a * (edges[:, 1] - edges[:, 0])) < f(edges[:, 0] + b * (edges[:, 1] - edges[:, 0])))[
            :, None
        ]
        low, high = np.where(left, low, a), np.where(left, b, high)
    middle = edges[:, 0] + (low + high) / 2 * (edges[:, 1] - edges[:, 0])
    return np.minimum(f(middle), np.minimum(f(edges[:, 0]), f(edges[:, 1])))


def link_distance(piece: ConvexPiece, points: np.ndarray) -> np.ndarray:
    """(N,) signed distance of points (N, 3) in the body frame: as `piece_distance`, and outside of boxes and cylinders
    the true one."""
    local = apply(invert(piece.pose), points)
    if piece.kind == "box":
        beyond = np.abs(local) - np.array(piece.size) / 2
    elif piece.kind == "cylinder":
        beyond = np.stack([np.hypot(local[:, 0], local[:, 1]), np.abs(local[:, 2])], -1)
        beyond -= [piece.size[0], piece.size[1] / 2]
    else:
        return piece_distance(piece, points)
    return np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0)


def nearest_edges(hand: HandModel, bodies: np.ndarray, obstacle: Obstacle, far: float) -> np.ndarray:
    """(P,) distance of the nearest of the obstacle's edges from each piece, or how deep an edge of the piece is in the
    obstacle; `far` where that is more. `bodies` (L, 7)."""
    out = np.full(len(hand.pieces), far)
    features = hand.features
    for number, piece in enumerate(hand.pieces):
        pose = bodies[piece.body]
        middle = piece.vertices.mean(axis=0)
        reach = np.linalg.norm(piece.vertices - middle, axis=1).max()
        if obstacle.distance(apply(pose, middle)) > reach + far:
            continue
        edges = apply(invert(pose), obstacle.corners)[obstacle.edges]
        half = np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1) / 2
        edges = edges[link_distance(piece, edges.mean(axis=1)) - half < far]  # no distance falls faster than one to one
        if len(edges):
            out[number] = min(far, least_along(lambda x, p=piece: link_distance(p, x), edges).min())
        mine = slice(features.first_edge[number], features.first_edge[number + 1])
        edges = apply(pose, features.edges[mine])
        pierce = (least_along(obstacle.distance, edges) - features.thickness[mine]).min()
        if pierce < min(out[number], 0.0):
            out[number] = pierce
    return out
