"""Draws of starts, all at once, against the same draws one by one, written out."""

from __future__ import annotations

import numpy as np

from graspd.service.model.transforms import quat_rotate
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.planners.fast_graspd import starts


def drawn_alone(pair: starts._Pair, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pivot, approach and posture of one draw, as the docstring of the module tells it."""
    hand = pair.hand
    face = int(pair.share.searchsorted(rng.random(), side="right"))
    u, v = rng.random(2)
    if u + v > 1:
        u, v = 1 - u, 1 - v
    a, b, c = pair.corners[face]
    point = a + u * (b - a) + v * (c - a)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal)
    tilt = starts._frame(normal)[:, :2] @ rng.normal(size=2)
    angle = np.linalg.norm(tilt) * starts.TILT
    axis = tilt / np.linalg.norm(tilt)
    approach = -(normal * np.cos(angle) + np.cross(axis, normal) * np.sin(angle))
    rng.uniform(0, 2 * np.pi)
    noise = starts.POSTURE_NOISE * (hand.upper - hand.lower) * rng.normal(size=hand.dofs)
    pivot = point - pair.centre - approach * rng.uniform(*starts.GAP)
    return pivot, approach, np.clip(hand.preshape + noise, hand.lower, hand.upper)


def test_draws_at_once_are_those_of_each_generator_alone() -> None:
    hand, obj = hand_from_path("allegro"), object_from_path("mug")
    pair = starts._Pair.of(hand, obj)
    state, approach = starts.draw(pair, [starts.start_generator(7, 0, i, 0) for i in range(64)])
    for i in range(64):
        pivot, way, q = drawn_alone(pair, starts.start_generator(7, 0, i, 0))
        # The same numbers in float64, in another order of sums.
        np.testing.assert_allclose(state.pivot[i], pivot, atol=1e-14)
        np.testing.assert_allclose(approach[i], way, atol=1e-13)
        np.testing.assert_allclose(state.q[i], q, atol=1e-14)
        np.testing.assert_allclose(quat_rotate(state.rotation[i], hand.palm.approach), way, atol=1e-12)
