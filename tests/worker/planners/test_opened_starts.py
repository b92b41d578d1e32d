"""Hands whose fingers leave no gap in their pre-shape open until they have a place; those that have one keep it."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from graspd.service.model.fidelity import FIDELITIES
from graspd.studies.stability.assets import ring_hand
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.planners import PlanRequest, synthesize
from graspd.worker.planners.fast_graspd.pairs import pair_of
from graspd.worker.planners.fast_graspd.starts import (
    CLEAR,
    NO_PLACE,
    clear_starts,
    open_further,
    start_generator,
)
from graspd.worker.simulation.model import Model
from tests.worker.simulation.rigs import object_of

DRAFT = FIDELITIES["draft"]


@pytest.fixture(scope="module")
def cube() -> ObjectModel:
    return object_of(trimesh.creation.box((0.06, 0.06, 0.06)))


@pytest.fixture(scope="module")
def ring() -> HandModel:
    """Its six fingers stand side by side."""
    return ring_hand(6)


def model_of(hand: HandModel, obj: ObjectModel) -> Model:
    pair = pair_of(hand, obj, DRAFT, "cpu")
    return pair.model(pair.coarse)


def test_a_ring_of_six_has_no_place_in_its_pre_shape_and_one_when_it_opens(ring: HandModel, cube: ObjectModel) -> None:
    model, generators = model_of(ring, cube), [start_generator(5, 0, i, 0) for i in range(4)]
    state, depth = clear_starts(model, generators)
    assert (depth > NO_PLACE).all()
    assert open_further(model, generators, state, depth, np.array([True, True, True, False])).tolist() == [1, 1, 1, 0]
    assert (depth[:3] <= CLEAR).all() and depth[3] > NO_PLACE
    closed = ring.closing > 0
    assert (state.q[:3, closed].mean(axis=1) < ring.preshape[closed].mean()).all()


def test_a_hand_that_has_a_place_keeps_it(cube: ObjectModel) -> None:
    model, generators = model_of(hand_from_path("barrett"), cube), [start_generator(5, 0, i, 0) for i in range(4)]
    state, depth = clear_starts(model, generators)
    before = state.pivot.copy(), state.rotation.copy(), state.q.copy()
    assert not open_further(model, generators, state, depth, np.ones(4, bool)).any()
    for was, now in zip(before, (state.pivot, state.rotation, state.q), strict=True):
        np.testing.assert_array_equal(was, now)


@pytest.mark.parametrize("threads", [1, 3])
def test_a_grasp_that_opened_does_not_depend_on_its_batch(ring: HandModel, cube: ObjectModel, threads: int) -> None:
    run = ExecutionContext(threads=threads)
    many = synthesize(ring, cube, PlanRequest(5, DRAFT, seed=3), run).grasp
    few = synthesize(ring, cube, PlanRequest(2, DRAFT, seed=3), run).grasp
    np.testing.assert_array_equal(many.hand_pose[:2], few.hand_pose)
    np.testing.assert_array_equal(many.joint_positions[:2], few.joint_positions)
