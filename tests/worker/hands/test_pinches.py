"""Postures for flat things: the ends of opposed fingertips rest on one plane and face each other just above it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graspd.service.model.transforms import IDENTITY_POSE, apply
from graspd.worker.hands.flat_pinches import HEIGHTS_M, OVER_M, pinches_of
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import hand_from_path

HEIGHT_M = 0.012


@pytest.mark.parametrize("name", ["allegro", "barrett", "shadow"])
def test_opposed_fingertips_end_on_one_plane_and_nothing_else_is_as_low(name: str) -> None:
    hand, found = hand_from_path(name), pinches_of(hand_from_path(name), HEIGHT_M)
    assert len(found) >= 20
    assert (np.diff(found.width) >= 0).all()
    down = hand.palm.approach - (found.axis @ hand.palm.approach)[:, None] * found.axis
    down /= np.linalg.norm(down, axis=1, keepdims=True)
    bodies = body_poses(hand, np.tile(IDENTITY_POSE, (len(found), 1)), hand.expand(found.q))
    # How far each piece reaches beyond the middle, which is half the height above the plane.
    reach = [
        np.einsum("nvi,ni->nv", apply(bodies[:, p.body, None], p.vertices) - found.middle[:, None], down).max(axis=1)
        for p in hand.pieces
    ]
    tips = {
        tip: np.max([r for r, p in zip(reach, hand.pieces, strict=True) if p.body == tip], axis=0)
        for tip in hand.fingertips
    }
    lowest = np.max(list(tips.values()), axis=0)
    assert lowest == pytest.approx(HEIGHT_M / 2, abs=2e-3)  # the surface is sampled
    low = np.sum([lowest - tip < HEIGHT_M for tip in tips.values()], axis=0)
    assert (low >= 2).all()
    others = np.max([r for r, p in zip(reach, hand.pieces, strict=True) if p.body not in hand.fingertips], axis=0)
    assert (lowest - others > 0.5 * OVER_M).all()


def test_what_reaches_the_pads_has_no_such_postures() -> None:
    hand = hand_from_path("barrett")
    assert len(pinches_of(hand, HEIGHTS_M[-1] + 1e-4)) == 0
    assert len(pinches_of(replace(hand, name="alone", fingertips=hand.fingertips[:1]), HEIGHT_M)) == 0
