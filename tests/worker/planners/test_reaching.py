"""Starts of free hands: draws, those that reach across an object, and hands that open until they have a place."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from graspd.service.model.fidelity import FIDELITIES
from graspd.service.model.transforms import quat_rotate
from graspd.studies.stability.assets import ring_hand
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.hands.jaws import fingertip_pad
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.planners import PlanRequest, synthesize
from graspd.worker.planners.fast_graspd import starts
from graspd.worker.planners.fast_graspd.antipodal_starts import ReachSampling
from graspd.worker.planners.fast_graspd.candidates import posture_of
from graspd.worker.planners.fast_graspd.pairs import pair_of
from graspd.worker.planners.fast_graspd.starts import (
    CLEAR,
    NO_PLACE,
    RETREATS,
    clear_starts,
    open_further,
    start_generator,
)
from graspd.worker.simulation.data import HandState
from graspd.worker.simulation.model import Model
from tests.worker.simulation.rigs import object_of

#: A box that an Allegro hand spans in one direction only, and half of its width there [m].
SIDES = (0.1, 0.24, 0.24)
HALF = SIDES[0] / 2


DRAFT = FIDELITIES["draft"]


def draft_model(hand: HandModel, obj: ObjectModel) -> Model:
    pair = pair_of(hand, obj, DRAFT, "cpu")
    return pair.model(pair.coarse)


def model_of(sides: tuple[float, float, float]) -> Model:
    return draft_model(hand_from_path("allegro"), object_of(trimesh.creation.box(sides)))


@pytest.fixture(scope="module")
def model() -> Model:
    return model_of(SIDES)


def starts_of(model: Model, count: int, each: int) -> tuple[HandState, np.ndarray]:
    return clear_starts(model, [start_generator(3, 0, i, k) for i in range(count) for k in range(each)], each=each)


def spans(model: Model, state: HandState) -> np.ndarray:
    """(n,) whether pads of fingertips are on both sides of the thin direction of the box."""
    hand = model.hand.model
    posture = posture_of(hand, model.obj.model, state)
    pose = body_poses(hand, posture.hand_pose, posture.joint_positions)[:, list(hand.fingertips)]
    pads = np.array([fingertip_pad(hand, tip).centre for tip in hand.fingertips])
    x = (quat_rotate(pose[..., 3:], pads) + pose[..., :3])[..., 0] - model.obj.model.centre_of_mass[0]
    return (x.min(axis=1) < -HALF) & (x.max(axis=1) > HALF)


def test_every_second_start_has_fingers_on_both_sides_of_a_box(model: Model) -> None:
    state, _ = starts_of(model, 24, 4)
    looking, reaching = spans(model, state).reshape(24, 2, 2).mean(axis=(0, 1))
    # 0.71 against 0.33: a palm that looks at a random place stands at an edge by chance.
    assert reaching > looking + 0.2


def test_starts_do_not_depend_on_others_and_draws_go_on(model: Model) -> None:
    reaching = ReachSampling.of(model)
    assert reaching is not None
    seeds, first, retreats = np.arange(8, dtype=np.int32), np.zeros(8, np.int32), np.array(RETREATS)
    found, number = reaching.starts(seeds, first, retreats)
    for i in (0, 3, 7):
        alone, draw = reaching.starts(seeds[i : i + 1], first[:1], retreats)
        assert draw[0] == number[i]
        for name in ("pivot", "rotation", "q"):
            np.testing.assert_array_equal(getattr(alone, name)[0], getattr(found, name)[i])
    # Draws go on where the last one ended.
    again, same = reaching.starts(seeds, number, retreats)
    later, after = reaching.starts(seeds, number + 1, retreats)
    np.testing.assert_array_equal(same, number)
    np.testing.assert_array_equal(again.pivot, found.pivot)
    more = after >= 0
    assert more.any()
    assert (after > number)[more].all()
    assert not (later.pivot == found.pivot)[more].all(axis=1).any()


def test_what_is_too_wide_all_over_is_looked_at_only() -> None:
    wide = model_of((0.25, 0.25, 0.25))
    assert ReachSampling.of(wide) is None
    looking, _ = starts_of(wide, 2, 2)
    alone = [start_generator(3, 0, i, k) for i in range(2) for k in range(2)]
    np.testing.assert_array_equal(looking.pivot, clear_starts(wide, alone)[0].pivot)


@pytest.mark.parametrize("side", [0.01, 0.2])
def test_all_starts_reach_around_what_pads_cannot_hold(side: float) -> None:
    model = model_of((side, side, side))
    reaching = ReachSampling.of(model)
    assert reaching is not None
    assert reaching.only
    _, depth = starts_of(model, 16, 2)
    assert (depth <= CLEAR).mean() > 0.9


def test_draws_are_those_of_each_generator_alone_and_look_at_the_object() -> None:
    hand, obj = hand_from_path("allegro"), object_from_path("mug")
    pair, seeds = starts._Pair(hand, obj), range(64)
    state, way = starts.draw(pair, [start_generator(7, 0, i, 0) for i in seeds])
    np.testing.assert_allclose(quat_rotate(state.rotation, hand.palm.approach), way, atol=1e-12)
    # From a palm the surface is as far away as the gap says, straight ahead.
    near, far = (state.pivot + gap * way + pair.centre for gap in starts.GAP)
    mesh = trimesh.Trimesh(obj.vertices, obj.faces)
    assert max(mesh.nearest.on_surface((near + far) / 2)[1]) <= (starts.GAP[1] - starts.GAP[0]) / 2 + 1e-9
    for i in seeds[::16]:
        alone, _ = starts.draw(pair, [start_generator(7, 0, i, 0)])
        np.testing.assert_array_equal(alone.pivot[0], state.pivot[i])
        np.testing.assert_array_equal(alone.q[0], state.q[i])


@pytest.fixture(scope="module")
def cube() -> ObjectModel:
    return object_of(trimesh.creation.box((0.06, 0.06, 0.06)))


@pytest.fixture(scope="module")
def ring() -> HandModel:
    """Its six fingers stand side by side."""
    return ring_hand(6)


def test_a_ring_of_six_has_a_place_only_when_it_opens(ring: HandModel, cube: ObjectModel) -> None:
    model, generators = draft_model(ring, cube), [start_generator(5, 0, i, 0) for i in range(4)]
    state, depth = clear_starts(model, generators)
    assert (depth > NO_PLACE).all()
    assert open_further(model, generators, state, depth, np.array([True, True, True, False])).tolist() == [1, 1, 1, 0]
    assert (depth[:3] <= CLEAR).all() and depth[3] > NO_PLACE
    closed = ring.closing > 0
    assert (state.q[:3, closed].mean(axis=1) < ring.preshape[closed].mean()).all()


def test_a_hand_that_has_a_place_keeps_it(cube: ObjectModel) -> None:
    model, generators = draft_model(hand_from_path("barrett"), cube), [start_generator(5, 0, i, 0) for i in range(4)]
    state, depth = clear_starts(model, generators)
    before = state.pivot.copy(), state.rotation.copy(), state.q.copy()
    assert not open_further(model, generators, state, depth, np.ones(4, bool)).any()
    for was, now in zip(before, (state.pivot, state.rotation, state.q), strict=True):
        np.testing.assert_array_equal(was, now)


@pytest.mark.parametrize("threads", [1, 3])
def test_a_grasp_that_opened_does_not_depend_on_its_batch(ring: HandModel, cube: ObjectModel, threads: int) -> None:
    run = ExecutionContext(threads=threads)
    many = synthesize(ring, cube, PlanRequest(5, FIDELITIES["draft"], seed=3), run).grasp
    few = synthesize(ring, cube, PlanRequest(2, FIDELITIES["draft"], seed=3), run).grasp
    np.testing.assert_array_equal(many.hand_pose[:2], few.hand_pose)
    np.testing.assert_array_equal(many.joint_positions[:2], few.joint_positions)
