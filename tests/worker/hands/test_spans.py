"""Postures that hold what pads cannot: both parts of the hand look at it, with room for it between them."""

from __future__ import annotations

import numpy as np
import pytest

from graspd.service.model.transforms import IDENTITY_POSE, quat_rotate
from graspd.worker.hands.grasp_widths import TURNED_M, Size, _Look, spans_of
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.pinch_postures import oppositions_of
from graspd.worker.hands.surface import sample_surface


@pytest.mark.parametrize("size", ["small", "wide"])
def test_the_hand_looks_at_the_thing_from_both_sides_and_leaves_it_room(size: Size) -> None:
    hand = hand_from_path("allegro")
    found, points = spans_of(hand, size), sample_surface(hand, 3000)
    assert len(found) >= 10
    assert ((found.q >= hand.lower) & (found.q <= hand.upper)).all()
    pose = body_poses(hand, np.tile(IDENTITY_POSE, (len(found), 1)), hand.expand(found.q))[:, points.body]
    place = quat_rotate(pose[..., 3:], points.position) + pose[..., :3]
    look = quat_rotate(pose[..., 3:], points.normal)
    for side in (-1, 1):
        end = found.middle + side * 0.5 * found.width[:, None] * found.axis
        near = np.linalg.norm(place - end[:, None], axis=2).argmin(axis=1)
        row = np.arange(len(found))
        # Points lie 4 mm apart.
        assert np.linalg.norm(place[row, near] - end, axis=1).max() < 0.006
        assert np.median(-side * np.einsum("ni,ni->n", look[row, near], found.axis)) > 0.7
    # A ball at the middle; what is wide may be held at its rim, so that its middle lies ahead. The search sees fewer
    # points of the hand than are looked at here.
    if size == "small":
        clear = np.linalg.norm(place - found.middle[:, None], axis=2).min(axis=1) > 0.2 * found.width
        assert clear.mean() > 0.9


def test_spans_begin_where_pads_end() -> None:
    hand = hand_from_path("allegro")
    pads = oppositions_of(hand).width
    assert spans_of(hand, "small").width[0] < pads[0] - 0.005
    assert spans_of(hand, "wide").width[-1] > pads[-1] + 0.005


def test_pairs_taken_together_cost_what_each_of_them_costs() -> None:
    look, rng = _Look(hand_from_path("barrett"), "small"), np.random.default_rng(0)
    count = len(look.holding)
    held, normal = rng.normal(0, 0.05, (2, count, 3)), rng.normal(size=(2, count, 3))
    wanted = np.array([0.01, 0.03])
    found = look._costs(held, normal, wanted)
    for one, other, its in list(zip(look.one, look.other, found.T, strict=True))[::997]:
        way = held[:, other] - held[:, one]
        width = np.linalg.norm(way, axis=1)
        facing = np.minimum((way * normal[:, one]).sum(axis=1), -(way * normal[:, other]).sum(axis=1)) / width
        cost = TURNED_M * np.maximum(0, look.facing - facing) + np.abs(width - wanted) + look.round[one, other]
        # Distances come from squares, so rounding of 1e-17 m² counts most where points nearly meet.
        np.testing.assert_allclose(its, cost, atol=1e-10)
    body = look.points.body[look.holding]
    assert (body[look.one] != body[look.other]).all()
    assert len(look.one) == (body[:, None] != body).sum() / 2
