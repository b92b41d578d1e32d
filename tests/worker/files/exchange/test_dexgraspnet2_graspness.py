"""Graspness of DexGraspNet 2.0 in cases that can be told by hand."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from service.model.transforms import IDENTITY_POSE
from worker.files.exchange.dexgraspnet2_graspness import (
    SAMPLES,
    SceneGraspness,
    back_projected,
    in_workspace,
    lines_of_sight,
    pointed_at,
    summed,
    surface_samples,
)
from worker.grasps import GraspSet, Posture
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel

DOWN = np.array([[0.0, 0, -1]])
ABOVE = np.array([[0.0, 0, 0.1]])
#: 100 px to a metre at a metre, a picture of 2 x 4.
K = np.array([[100.0, 0, 1], [0, 100, 0.5], [0, 0, 1]])


def test_a_grasp_points_straight_ahead_or_nearest_within_30_deg() -> None:
    # Where all lie as deep, the angle decides.
    surface = np.array([[0.02, 0, 0], [0.005, 0, 0], [-0.03, 0, 0]])
    assert pointed_at(ABOVE, DOWN, surface).tolist() == [1]
    outside, behind = 0.1 * np.tan(np.radians(31)), 0.12
    assert pointed_at(ABOVE, DOWN, np.array([[outside, 0, 0], [0, 0, behind], [0, 0, -0.05]])).tolist() == [2]
    assert pointed_at(ABOVE, DOWN, np.array([[0.3, 0, 0], [0, 0, 0.12]])).tolist() == [1]


@pytest.mark.parametrize(("degrees", "best"), [(4.5, 1), (5.5, 0)])
def test_ten_degrees_weigh_as_fifteen_millimetres(degrees: float, best: int) -> None:
    # The first lies 7.5 mm deeper on the line, which is worth five degrees.
    aside = 0.1 * np.tan(np.radians(degrees))
    assert pointed_at(ABOVE, DOWN, np.array([[0, 0, -0.0075], [aside, 0, 0]])).tolist() == [best]


def test_what_lies_20_mm_behind_the_first_point_is_not_seen() -> None:
    # By weight alone the deeper point would win: 28 degrees cost 2.8, 21 mm only 1.4.
    aside = 0.1 * np.tan(np.radians(28))
    assert pointed_at(ABOVE, DOWN, np.array([[aside, 0, 0], [0, 0, -0.021]])).tolist() == [0]
    assert pointed_at(ABOVE, DOWN, np.array([[aside, 0, 0], [0, 0, -0.019]])).tolist() == [1]


def test_grasp_counts_tenth_at_each_150th_of_metre_without_none(hand: HandModel, block: ObjectModel) -> None:
    surface = np.array([[0.0, 0, 0], [1 / 150, 0, 0], [3 / 150, 0, 0]])
    np.testing.assert_allclose(summed(surface, np.array([0, 0, 1])), [2.1, 1.2, 0.012], rtol=1e-12)
    none = Posture(np.zeros((0, 7)), np.zeros((0, len(hand.joint_names))))
    found = SceneGraspness.of(hand, none, surface_samples(block))
    assert found.values.shape == (SAMPLES,) and not found.values.any() and len(found.pointed) == 0


def test_pixels_of_the_object_take_what_is_nearest() -> None:
    """The camera looks at a wall 0.5 m away, its pixels 5 mm apart; right above on the table's x-y."""
    depth = np.full((2, 4), 0.5)
    depth[1, 1] = 0
    labels = np.array([[1, 1, 2, 0], [1, 0, 0, 0]], np.uint8)
    surface = np.array([[-0.005, -0.0025, 0.0], [0.0, -0.0025, 0.0]])
    scene = SceneGraspness(surface, np.array([0]), np.array([1.0, 0.25]))
    ahead = np.array([0, 0, 0.5, 1, 0, 0, 0])
    values = scene.of_view(depth, labels, K, np.eye(4), ahead)
    # Row by row: two of the object, its neighbour, table; the object again, a hole, which is no point, and table.
    assert values.shape == (7, 1)
    np.testing.assert_allclose(values[:, 0], [1, 0.25, 0, 0, 1, 0, 0])
    # An object that stands 13 cm from where the picture shows it is out of reach.
    assert not scene.of_view(depth, labels, K, np.eye(4), ahead + np.array([0, 0, 0.13, 0, 0, 0, 0])).any()


def test_the_workspace_is_20_mm_about_what_is_labelled() -> None:
    depth = np.full((2, 40), 0.5)
    labels = np.zeros((2, 40), np.uint8)
    labels[:, 10] = 1
    inside = in_workspace(back_projected(depth, K), depth, labels, np.eye(4))
    # Pixels are 5 mm apart: three on each side, for the fourth lies on the border or a rounding from it.
    assert inside[:, 7:14].all() and not inside[:, :6].any() and not inside[:, 15:].any()
    # A labelled hole is a place at the camera, which widens the box.
    depth[0, 10] = 0
    assert not in_workspace(back_projected(depth, K), depth, labels, np.eye(4))[0, 10]
    assert in_workspace(back_projected(depth, K), depth, labels, np.eye(4))[:, 2].all()


def test_a_hand_looks_between_its_thumb_and_its_fingers(hand: HandModel, grasps: GraspSet) -> None:
    palm, line = lines_of_sight(hand, grasps.grasp)
    np.testing.assert_allclose(np.linalg.norm(line, axis=1), 1)
    assert palm.shape == (len(grasps.grasp), 3)
    one = replace(hand, fingertips=hand.fingertips[:1])
    still = Posture(IDENTITY_POSE[None], hand.expand(hand.preshape)[None])
    np.testing.assert_allclose(lines_of_sight(one, still)[1], hand.palm.approach[None])
    # A Barrett's fingers meet before its palm.
    assert lines_of_sight(hand, still)[1] @ hand.palm.approach > 0.9


def test_points_are_even_and_the_same_each_time(block: ObjectModel) -> None:
    points = surface_samples(block)
    np.testing.assert_array_equal(points, surface_samples(block))
    apart = np.linalg.norm(points[:, None] - points[None], axis=2) + np.eye(SAMPLES)
    area = (
        float(np.linalg.norm(np.cross(*np.moveaxis(np.diff(block.vertices[block.faces], axis=1), 1, 0)), axis=1).sum())
        / 2
    )
    assert apart.min(axis=1).min() > 0.4 * np.sqrt(area / SAMPLES)


def test_many_grasps_take_no_more_memory(block: ObjectModel) -> None:
    surface = surface_samples(block)

    def most(count: int) -> int:
        palm = np.random.default_rng(0).normal(size=(count, 3)) * 0.2
        line = -palm / np.linalg.norm(palm, axis=1, keepdims=True)
        tracemalloc.start()
        summed(surface, pointed_at(palm, line, surface))
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return peak

    assert most(1536) < 1.2 * most(512) < 100 * 2**20
