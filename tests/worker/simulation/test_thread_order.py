"""What many threads add up does not depend on the order in which they run."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
import trimesh
import warp as wp

from graspd.service.model.fidelity import FIDELITIES
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.planners import PlanRequest
from graspd.worker.planners.fast_graspd import planner
from graspd.worker.simulation.data import Data
from graspd.worker.simulation.kernels import packing, wrenches
from graspd.worker.simulation.kernels.wrenches import Wrenches, add_wrench
from tests.worker.models import object_from_mesh, two_finger_hand

FIDELITY = FIDELITIES["draft"].model_copy(update={"coarse_iterations": 20, "fine_iterations": 20})


@wp.kernel
def add_all(force_in: wp.array(dtype=wp.vec3), wrench_inout: Wrenches):
    i = wp.tid()
    add_wrench(wrench_inout, 0, 0, force_in[i], 0.1 * force_in[i])


def summed(forces: np.ndarray) -> np.ndarray:
    """Counts (6,) of all forces (n, 3) and a tenth of them as torques."""
    wrench = wp.zeros((1, 1, 6), dtype=wp.int64, device="cpu")
    given = wp.array(forces.astype(np.float32), dtype=wp.vec3, device="cpu")
    wp.launch(add_all, len(forces), inputs=[given], outputs=[wrench], device="cpu")
    return wrench.numpy()[0, 0]


def test_wrenches_have_the_same_bits_in_any_order() -> None:
    # Sizes from 1e-3 to 1e4, as in a batch: float32 sums of them differ in their last digits.
    rng = np.random.default_rng(5)
    forces = rng.normal(size=(500, 3)) * 10.0 ** rng.uniform(-3, 4, (500, 1))
    shuffled = forces[rng.permutation(500)]
    assert (
        np.add.accumulate(forces.astype(np.float32))[-1] != np.add.accumulate(shuffled.astype(np.float32))[-1]
    ).any()
    assert (summed(forces) == summed(shuffled)).all()


def test_wrenches_add_up() -> None:
    forces = np.random.default_rng(6).normal(size=(300, 3)).astype(np.float32)
    found = summed(forces) * wrenches.UNIT
    # Each addend loses less than one count, and the tenth is rounded to float32.
    np.testing.assert_allclose(found[:3], forces.astype(float).sum(axis=0), atol=300 * wrenches.UNIT)
    np.testing.assert_allclose(found[3:], 0.1 * forces.astype(float).sum(axis=0), atol=1e-5)


def test_what_is_no_number_adds_nothing() -> None:
    assert (summed(np.array([[np.nan, np.inf, -np.inf]])) == 0).all()


@pytest.mark.parametrize("count", [1, 31, 32, 33, 95])
def test_marked_points_get_the_slots_of_a_counter(count: int) -> None:
    rng = np.random.default_rng(count)
    mark = rng.integers(0, 3, (4, count)).astype(np.int32)
    active = wp.array([1, 1, 0, 1], dtype=wp.int32)
    counts = [wp.zeros((4, -(-count // packing.CHUNK)), dtype=wp.int32) for _ in range(2)]
    marked = wp.array(mark)
    wp.launch(packing.count_marks, counts[0].shape, inputs=[active, marked], outputs=counts, device="cpu")
    index = wp.array(np.tile(np.arange(count, dtype=np.int32), (4, 1)))
    point, real = wp.zeros((4, count), dtype=wp.vec3), wp.zeros((4, count), dtype=wp.float32)
    body, near = (wp.full((4, count), -1, dtype=wp.int32) for _ in range(2))
    totals = [wp.full(4, -1, dtype=wp.int32) for _ in range(2)]
    wp.launch(
        packing.pack,
        (4, count),
        inputs=[active, marked, *counts, index, point, point, real, real],
        outputs=[totals[0], body, point, point, real, real, real, totals[1], near],
        device="cpu",
    )
    for b in (0, 1, 3):
        kept, close = np.flatnonzero(mark[b]), np.flatnonzero(mark[b] == packing.NEAR)
        assert totals[0].numpy()[b] == len(kept)
        assert totals[1].numpy()[b] == len(close)
        assert (body.numpy()[b, : len(kept)] == kept).all()
        assert (kept[near.numpy()[b, : len(close)]] == close).all()
    assert totals[0].numpy()[2] == -1


def test_a_batch_has_the_same_bits_where_threads_come_in_any_order(monkeypatch: pytest.MonkeyPatch) -> None:
    box = object_from_mesh(trimesh.creation.box((0.05, 0.05, 0.08)))
    states = []
    for serial in (True, False):
        monkeypatch.setattr(planner, "Data", partial(Data, serial=serial))
        (part,) = planner.optimise_batch(
            two_finger_hand(), box, PlanRequest(2, FIDELITY, seed=3), ExecutionContext("cpu", threads=1)
        )
        assert part.state is not None
        states.append(part.state)
    for name in ("pivot", "rotation", "q"):
        assert (getattr(states[0], name) == getattr(states[1], name)).all()
