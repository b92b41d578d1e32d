"""Surface samples: how many, where, and how much area they stand for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from graspd.service.model.transforms import IDENTITY_POSE, apply
from graspd.worker.hands import surface
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import hand_from_path, load_hand
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.surface import (
    BURIED_M,
    COINCIDENT_M,
    apportion,
    farthest_points,
    piece_distance,
    sample_surface,
)
from tests.worker.hands.urdfs import joint, link, robot

#: Area is measured by at least 30,000 random candidates: the standard error of a share p is sqrt(p (1-p) / 30000), here
#: below 0.3 %; four of these.
AREA_TOLERANCE = 0.012
ON_SURFACE_M = 1e-9


def shape(geometry: str, xyz: str = "0 0 0") -> str:
    return f'<collision><origin xyz="{xyz}"/><geometry>{geometry}</geometry></collision>'


def hand_of(*palm_shapes: str, finger: str = shape('<sphere radius="0.01"/>', "0 0 1")) -> HandModel:
    """A hand whose palm has the given shapes and whose only finger is a sphere far away."""
    urdf = robot(link("palm", "".join(palm_shapes)), link("a", finger), joint("j", "palm", "a"))
    return load_hand({"h.urdf": urdf}, name="h", digest="".join(palm_shapes) + finger)


def palm_area(hand: HandModel, count: int = 1500) -> float:
    points = sample_surface(hand, count)
    return float(points.area[points.body == 0].sum())


@pytest.mark.parametrize(
    ("geometry", "area"),
    [
        ('<box size="0.1 0.06 0.02"/>', 2 * (0.006 + 0.0012 + 0.002)),
        ('<sphere radius="0.05"/>', 4 * np.pi * 0.0025),
        ('<cylinder radius="0.03" length="0.1"/>', 2 * np.pi * 0.03 * 0.13),
        ('<capsule radius="0.03" length="0.1"/>', 2 * np.pi * 0.03 * 0.16),
    ],
)
def test_areas_of_a_lone_primitive_sum_to_its_closed_form(geometry: str, area: float) -> None:
    assert palm_area(hand_of(shape(geometry))) == pytest.approx(area, rel=1e-3)


def test_parts_inside_another_piece_carry_no_area() -> None:
    """Two spheres of radius r whose centres are r apart: each loses a cap of height r/2, a quarter of its area."""
    sphere = '<sphere radius="0.04"/>'
    hand = hand_of(shape(sphere), shape(sphere, "0 0 0.04"))
    assert palm_area(hand) == pytest.approx(2 * 0.75 * 4 * np.pi * 0.04**2, rel=AREA_TOLERANCE)


def test_faces_that_touch_each_other_are_not_surface() -> None:
    """Two cubes glued face to face are one box: their common face is inside."""
    cube = '<box size="0.04 0.04 0.04"/>'
    hand = hand_of(shape(cube), shape(cube, "0 0 0.04"))
    assert palm_area(hand) == pytest.approx(10 * 0.04**2, rel=AREA_TOLERANCE)


def test_a_face_that_two_pieces_share_counts_once() -> None:
    """A box inside a larger one, flush with its top."""
    hand = hand_of(shape('<box size="0.08 0.08 0.04"/>'), shape('<box size="0.04 0.04 0.02"/>', "0 0 0.01"))
    assert palm_area(hand) == pytest.approx(2 * 0.08**2 + 4 * 0.08 * 0.04, rel=AREA_TOLERANCE)


def test_a_point_inside_another_body_at_rest_is_dropped() -> None:
    hand = hand_of(shape('<box size="0.1 0.1 0.1"/>'), finger=shape('<sphere radius="0.02"/>', "0 0 0"))
    points = sample_surface(hand, 300)
    finger = points.position[points.body == 1]
    world = apply(body_poses(hand, IDENTITY_POSE, hand.expand(hand.preshape))[0, 1], finger)
    (palm,) = (piece for piece in hand.pieces if piece.body == 0)
    assert len(finger) and piece_distance(palm, world).min() >= -BURIED_M


@pytest.mark.parametrize("count", [16, 400, 2000])
def test_the_count_is_exact_also_on_a_thin_shell(count: int) -> None:
    hand = hand_of(shape('<box size="0.2 0.2 0.0005"/>'))
    assert len(sample_surface(hand, count)) == count


def test_a_thin_plate_has_points_on_both_sides() -> None:
    points = sample_surface(hand_of(shape('<box size="0.2 0.2 0.0005"/>')), 400)
    top = (points.normal[points.body == 0, 2] > 0.9).sum()
    bottom = (points.normal[points.body == 0, 2] < -0.9).sum()
    assert 0.8 < top / bottom < 1.25


def test_the_same_seed_gives_the_same_points_and_another_seed_others() -> None:
    first, other = hand_from_path("allegro"), hand_from_path("allegro")
    a = sample_surface(first, 500, seed=3)
    surface._samples.clear()
    b = sample_surface(other, 500, seed=3)
    assert a is not b
    np.testing.assert_array_equal(a.position, b.position)
    np.testing.assert_array_equal(a.area, b.area)
    assert not np.array_equal(a.position, sample_surface(first, 500, seed=4).position)


def test_a_surface_is_sampled_once_however_the_hand_is_said_to_close_and_anew_in_another_pre_shape() -> None:
    hand = hand_from_path("allegro")
    points = sample_surface(hand, 300)
    assert sample_surface(replace(hand, closing=-hand.closing), 300) is points
    bent = replace(hand, preshape=0.5 * (hand.lower + hand.upper))
    assert sample_surface(bent, 300) is not points


@pytest.mark.parametrize("name", ["allegro", "barrett", "shadow"])
def test_points_lie_on_the_surface_with_outward_unit_normals(name: str) -> None:
    hand = hand_from_path(name)
    points = sample_surface(hand, 800)
    np.testing.assert_allclose(np.linalg.norm(points.normal, axis=1), 1.0, atol=1e-9)
    for body in range(hand.bodies):
        mine = points.body == body
        pieces = [piece for piece in hand.pieces if piece.body == body]
        if not mine.any():
            continue
        nearest = np.min([piece_distance(p, points.position[mine]) for p in pieces], axis=0)
        outside = points.position[mine] + COINCIDENT_M * points.normal[mine]
        above = np.min([piece_distance(p, outside) for p in pieces], axis=0)
        assert np.abs(nearest).max() < ON_SURFACE_M
        assert (above >= 0).all()


def test_points_spread_more_evenly_than_random_ones() -> None:
    """Blue noise keeps the nearest neighbours apart: random points come arbitrarily close."""
    hand = hand_of(shape('<sphere radius="0.05"/>'))
    points = sample_surface(hand, 600)
    mine = points.position[points.body == 0]
    gaps = cKDTree(mine).query(mine, k=2)[0][:, 1]
    spacing = np.sqrt(4 * np.pi * 0.05**2 / len(mine))
    assert gaps.min() > 0.5 * spacing


def test_seats_follow_weights_and_never_exceed_what_is_there() -> None:
    seats = apportion(np.array([3.0, 1.0, 0.0]), 8, np.array([100, 100, 100]))
    assert seats.tolist() == [6, 2, 0]
    assert apportion(np.array([3.0, 1.0]), 8, np.array([2, 100])).tolist() == [2, 6]


def test_farthest_points_are_distinct() -> None:
    points = np.random.default_rng(0).random((50, 3))
    assert len(set(farthest_points(points, 50).tolist())) == 50
