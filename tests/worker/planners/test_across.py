"""Starts across an object: pairs of points that look away from each other, and hands that hold between them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from service.model.domain import resolve_fidelity
from service.model.transforms import quat_rotate
from tests.worker.simulation.rigs import ball
from worker.hands.load import hand_from_path
from worker.hands.oppositions import oppositions_of
from worker.objects.prepare import object_from_path
from worker.planners.fast_graspd.across import ACROSS, LOW_M, Openings, across, crossings_of
from worker.planners.fast_graspd.pairs import pair_of
from worker.planners.fast_graspd.withdrawal import hindrance
from worker.simulation.obstacles import DeviceObstacles
from worker.simulation.state import HandState
from worker.simulation.surroundings import Obstacle, Scenes, Surroundings

UP = np.array([0.0, 0, 1])


def lying(obj) -> Surroundings:
    """The object on a table as its mesh stands."""
    return Surroundings((Obstacle.half_space(UP, float(obj.vertices[:, 2].min())),), UP)


def on_its_table(obj) -> Scenes:
    """The same as a scene; the object's frame is the table's."""
    return Scenes(lying(obj).obstacles, np.array([[0.0, 0, 0, 1, 0, 0, 0]]))


@pytest.fixture(scope="module")
def block():
    return object_from_path("block", face_error_m=1e-3)


@pytest.fixture(scope="module")
def barrett():
    return hand_from_path("barrett")


def test_pairs_of_a_ball_are_its_chords_within_the_cones() -> None:
    obj = ball()
    pairs = crossings_of(obj)
    off = np.linalg.norm(pairs.middle - obj.centre_of_mass, axis=1)
    radius = np.hypot(0.5 * pairs.width, off)
    assert radius.max() - radius.min() < 0.05 * obj.radius  # a mesh of flat faces
    assert radius == pytest.approx(obj.radius, rel=0.05)
    # A chord at an angle t to the normals is 2 r cos t long; normals of faces are off by a few degrees.
    assert (0.5 * pairs.width / obj.radius).min() > ACROSS - 0.06
    assert max(np.linalg.norm(end - obj.centre_of_mass, axis=1).max() for end in pairs.ends()) <= obj.radius + 1e-9


def test_what_a_hand_cannot_span_or_reach_is_told(block, barrett) -> None:
    known = oppositions_of(barrett)
    assert Openings.of(known, block, lying(block)).within_reach
    deep = Surroundings((Obstacle.half_space(UP, float(block.vertices[:, 2].max()) + 0.01),), UP)
    assert not Openings.of(known, block, deep).within_reach
    wide = replace(block, vertices=10 * block.vertices, centre_of_mass=10 * block.centre_of_mass)
    opening = Openings.of(known, wide, lying(wide))
    assert not opening.within_reach
    assert not len(opening.sums)


def test_hands_hold_the_middle_between_their_fingers_and_come_from_a_free_way(block, barrett) -> None:
    rng = np.random.default_rng(0)
    opening, known = Openings.of(oppositions_of(barrett), block, lying(block)), oppositions_of(barrett)
    uniform = rng.random((40, 6))
    uniform[:, 5] = 0.0
    pivot, rotation, q, away, _ = across(
        barrett, block, opening, uniform, np.zeros((40, barrett.dofs)), np.array([[0.0, 0, 1]])
    )
    # Without noise the dofs are those of one of the known postures, whose middle lies in that of a pair.
    posture = np.array([np.abs(known.q - row).sum(axis=1).argmin() for row in q])
    middle = pivot + block.centre_of_mass + quat_rotate(rotation, known.middle[posture] - barrett.palm.centre)
    gap = np.linalg.norm(middle[:, None] - opening.pairs.middle[None], axis=-1).min(axis=1)
    assert gap == pytest.approx(0.0, abs=1e-9)
    level = np.abs(quat_rotate(rotation, known.axis[posture])[:, 2]) < 0.5
    # Across a level line a hand can come as the way says, up to how squarely its palm looks.
    assert (away[level, 2] > 0.3).all()


def test_a_hand_around_an_edge_is_hindered_and_one_before_it_is_not(block, barrett) -> None:
    pair = pair_of(barrett, block, resolve_fidelity("draft"), "cpu")
    solids = DeviceObstacles.create(barrett, [lying(block)], block.centre_of_mass, "cpu")
    model = pair.model(pair.coarse, solids)
    top = float(block.vertices[:, 2].max()) - block.centre_of_mass[2]
    down = np.array([0.0, 1.0, 0.0, 0.0])  # the palm looks along its z axis: turned about x it looks down
    wide = barrett.lower + 0.1 * barrett.span
    closed = np.where(barrett.closing > 0, barrett.upper, barrett.lower)
    at = np.array([[0, 0, top + 0.15], [0, 0, top + 0.03]])
    states = HandState(at, np.tile(down, (2, 1)), np.stack([wide, closed]))
    lost = hindrance(model, states, on_its_table(block).placed(np.zeros(2, int)))
    assert lost[0] == 0.0
    assert lost[1] > 0.1


@pytest.mark.parametrize(("room_m", "hindered"), [(0.06, True), (0.30, False)])
def test_a_hand_below_a_board_is_hindered_where_it_cannot_rise(block, barrett, room_m, hindered) -> None:
    pair = pair_of(barrett, block, resolve_fidelity("draft"), "cpu")
    top = float(block.vertices[:, 2].max())
    # The palm is 15 cm above the block, the board `room_m` above the palm; the hand's back is some cm thick.
    board = Obstacle.box([0, 0, top + 0.15 + room_m + 0.25, 1, 0, 0, 0], [1.0, 1.0, 0.5])
    scenes = replace(on_its_table(block), supports=(*on_its_table(block).supports, board))
    placed = scenes.placed(np.zeros(1, int))
    model = pair.model(pair.coarse, DeviceObstacles.create(barrett, placed.scenes, block.centre_of_mass, "cpu"))
    state = HandState(
        np.array([[0, 0, top - block.centre_of_mass[2] + 0.15]]),
        np.array([[0.0, 1.0, 0.0, 0.0]]),
        (barrett.lower + 0.1 * barrett.span)[None],
    )
    assert (hindrance(model, state, placed)[0] > 0.1) == hindered


def test_what_lies_low_is_told_only_where_fingertips_may_touch(block, barrett) -> None:
    known, flat = oppositions_of(barrett), block.vertices * [1, 1, 0.2]
    thin = replace(block, vertices=flat, centre_of_mass=block.centre_of_mass * [1, 1, 0.2], digest="7" * 64)
    scene = lying(thin)
    assert not Openings.of(known, thin, scene).low.any()
    (table,) = scene.obstacles
    opening = Openings.of(known, thin, replace(scene, obstacles=(replace(table, tips_m=0.0),)))
    height = opening.pairs.middle[:, 2] - flat[:, 2].min()
    assert np.array_equal(opening.low, height < LOW_M) and opening.low.any()
    uniform, ways = np.random.default_rng(0).random((40, 6)), np.array([[0.0, 0, 1]])
    *_, low = across(barrett, thin, opening, uniform, np.zeros((40, barrett.dofs)), ways)
    assert np.array_equal(low, opening.low[np.searchsorted(opening.sums, uniform[:, 0])])
