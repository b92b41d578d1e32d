"""Near-duplicates, types and directions of grasps, against what can be worked out by hand."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import trimesh

from graspd.exchange.inputs import load_case
from graspd.service.model.metrics import DIRECTION_CELLS, GraspType, entropy_bits, evenness
from graspd.service.model.transforms import apply, quat_from_axis_angle
from graspd.worker.grasps import Posture
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.quality import diversity
from graspd.worker.quality.diversity import POINTS, approach_cells, cells_of, distances, distinct, hand_points, nearest
from graspd.worker.quality.table import measure
from tests.worker.models import object_from_mesh
from tests.worker.quality.helpers import grasp_set, pad_hand, plate_hand, posture

FIRST, SECOND = np.array([0]), np.array([1])


def moved(hand: HandModel, by: float) -> np.ndarray:
    """Points of a hand at rest and of the same shifted by `by` [m]."""
    joints = np.zeros((2, len(hand.joint_names)))
    pose = np.array([[0, 0, 0, 1, 0, 0, 0], [0.6 * by, 0, 0.8 * by, 1, 0, 0, 0]], float)
    return hand_points(hand, Posture(pose, joints))


@pytest.mark.parametrize("by", [0.0, 0.003, 0.05])
def test_distance_of_a_shifted_hand_is_the_shift(by: float) -> None:
    # To rounding: every point moves by the same.
    assert distances(moved(pad_hand(), by), FIRST, SECOND) == pytest.approx([by], abs=1e-12)


def test_distance_counts_a_joint_by_what_it_moves() -> None:
    """Half of the points sit on the two pads; one pad slides by 10 mm."""
    hand = plate_hand()
    points = hand_points(hand, posture(((0, 0, 0), (0.02, 0.02)), ((0, 0, 0), (0.03, 0.02))))
    slid = np.linalg.norm(points[0] - points[1], axis=1) > 1e-9
    assert 0 < slid.sum() < POINTS
    assert distances(points, FIRST, SECOND) == pytest.approx([0.010 * slid.mean()], abs=1e-12)


def test_distance_does_not_depend_on_where_the_object_lies() -> None:
    hand = pad_hand()
    rng = np.random.default_rng(5)
    two = posture(((0.01, 0, 0), (0.02, 0.03)), ((0, 0.02, 0), (0.01, 0.02)))
    points = hand_points(hand, two)
    turn = np.array([*rng.normal(size=3), *quat_from_axis_angle(np.array([0.6, 0, 0.8]), 1.1)])
    there = apply(np.tile(turn, (2, POINTS, 1)), points)
    assert distances(there, FIRST, SECOND) == pytest.approx(distances(points, FIRST, SECOND), rel=1e-9)


@pytest.mark.parametrize("few", [0, 1000])
def test_of_grasps_that_are_near_the_first_is_kept(few: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(diversity, "FEW", few)
    rng = np.random.default_rng(11)
    points = rng.normal(0, 0.02, (200, 1, 3)) + rng.normal(0, 0.002, (200, 8, 3))
    kept = distinct(points, 0.01)
    apart = np.linalg.norm(points[:, None] - points[None], axis=3).mean(axis=2)
    among = apart[np.ix_(kept, kept)] + np.eye(int(kept.sum()))
    assert among.min() >= 0.01 and kept[0]
    for row in np.flatnonzero(~kept):
        assert apart[row, :row][kept[:row]].min() < 0.01  # nobody is dropped for one that is dropped itself


def test_the_nearest_two_are_found_among_all_pairs() -> None:
    rng = np.random.default_rng(17)
    # Turned about their middles too, so that near middles are no near grasps.
    points = rng.normal(0, 0.05, (60, 1, 3)) + rng.normal(0, 0.03, (60, 8, 3))
    rows, others = np.triu_indices(len(points), 1)
    assert nearest(points) == pytest.approx(distances(points, rows, others).min(), rel=1e-12)
    assert nearest(points[:1]) is None and nearest(np.zeros((3, 8, 3))) == 0


def test_least_distance_of_zero_keeps_twins_and_given_ones_are_kept() -> None:
    points = np.zeros((3, 4, 3))
    assert distinct(points, 0.0).all()
    assert distinct(points, 0.005).tolist() == [True, False, False]
    assert distinct(points, 0.005, given=2).tolist() == [True, True, False]


def test_entropy_of_even_kinds_is_the_logarithm_of_their_number() -> None:
    assert entropy_bits([7] * 48) == pytest.approx(math.log2(48)) and evenness(
        [7] * 48, DIRECTION_CELLS
    ) == pytest.approx(1)
    assert entropy_bits([9, 0]) == 0 and entropy_bits([]) == 0 and evenness([], 3) == 0
    assert entropy_bits([1, 1, 2]) == pytest.approx(1.5)


def test_cell_of_an_approach_is_that_of_where_the_palm_comes_from() -> None:
    hand = pad_hand()  # its palm looks along z
    upright, upside_down = [1.0, 0, 0, 0], [0.0, 1, 0, 0]
    low, high = approach_cells(hand, np.array([upright, upside_down]))
    assert low // 12 == 0 and high // 12 == 3
    assert cells_of(np.array([[-1.0, -1e-9, -0.9], [1.0, 0, 0.1]])).tolist() == [0, 2 * 12 + 6]


def hand_on(radius: float, at: float, q: np.ndarray) -> int:
    """Type of a grasp of an Allegro hand with dofs q (16,) of a ball that lies before its palm, `at` [m] from it."""
    hand = hand_from_path("allegro")
    centre = hand.palm.centre + hand.palm.approach * (at + radius)
    ball = object_from_mesh(trimesh.creation.icosphere(subdivisions=3, radius=radius))
    pose = np.array([[*-centre, 1, 0, 0, 0]])
    grasp = grasp_set(Posture(pose, hand.expand(q[None])))
    return int(measure(hand, ball, grasp)["quality/grasp_type"][0])


def test_a_ball_in_the_palm_is_held_in_a_power_grasp() -> None:
    hand = hand_from_path("allegro")
    closed = np.where(hand.closing != 0, hand.lower + 0.7 * hand.span, hand.preshape)
    assert hand_on(0.03, 0.0, closed) == GraspType.POWER


def test_a_hand_that_touches_nothing_has_no_type() -> None:
    hand = hand_from_path("allegro")
    assert hand_on(0.01, 0.5, hand.preshape) == GraspType.NONE


def test_pads_that_meet_on_a_ball_are_a_precision_grasp() -> None:
    ball = object_from_mesh(trimesh.creation.icosphere(subdivisions=3, radius=0.03))
    # Pads stand 65 mm from the middle and slide inwards by 65 - 30 - 5 mm.
    found = measure(pad_hand(), ball, grasp_set(posture(((0, 0, 0), (0.065, 0.065)))))
    assert found["quality/grasp_type"].tolist() == [GraspType.PRECISION]


def test_fingers_that_touch_by_their_sides_are_a_lateral_grasp() -> None:
    """A thin card between two straight fingers: what they touch it with looks along their axes of flexion."""
    hand = hand_from_path("allegro")
    from graspd.worker.hands.kinematics import body_poses

    straight = np.clip(np.zeros(hand.dofs), hand.lower, hand.upper)
    poses = body_poses(hand, np.array([[0.0, 0, 0, 1, 0, 0, 0]]), hand.expand(straight[None]))[0]
    first, second = (poses[body, :3] for body in hand.fingertips[:2])
    middle, across = (first + second) / 2, second - first
    gap = float(np.linalg.norm(across))
    width = gap - 2 * 0.0135
    side = np.argmax(np.abs(across))
    size = np.full(3, 0.02)
    size[side] = width
    card = object_from_mesh(trimesh.creation.box(size))
    pose = np.array([[*-middle, 1, 0, 0, 0]])
    found = measure(hand, card, grasp_set(Posture(pose, hand.expand(straight[None]))))
    assert found["quality/contact_links"][0] >= 2
    assert found["quality/grasp_type"].tolist() == [GraspType.LATERAL]


def test_published_fingertip_grasps_are_precision_grasps(shared_data: Path) -> None:
    """FRoGGeR plans with four fixed points on the fingertips, so whoever plans nothing else holds nothing else."""
    case = load_case(shared_data / "reference_grasps" / "frogger_allegro" / "056_tennis_ball.json")
    some = case.grasps.take(np.arange(6))
    types = measure(case.hand, case.obj, some, thresholds_m=[0.005])["quality/grasp_type"]
    assert (types == GraspType.PRECISION).all()
