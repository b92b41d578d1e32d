"""The contact solve in float64 against the float64 reference, and what of it reaches the planner."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp

from service.domain import FIDELITIES
from worker import backend
from worker.hands.load import hand_from_path
from worker.objects.prepare import object_from_path
from worker.planners.fast_graspd.pairs import Pair, pair_of
from worker.planners.fast_graspd.schedule import coarse_schedule
from worker.planners.fast_graspd.starts import sample_starts
from worker.simulation import reference
from worker.simulation.reference import Contacts, World
from worker.simulation.simulation import LossOptions, Simulation, initial_motions
from worker.studies.chart import contact64
from worker.studies.chart.sweeps import Turn, _run
from worker.studies.chart.variants import physics64, solving_in_64
from worker.studies.stability.gradients import kernel_gradient

PASSES = 12
INERTIA = np.diag([8e-4, 6e-4, 4e-4])
OPTIONS = LossOptions(leak=0.0)
WORLD = World(
    inertia=INERTIA, gyration=float(np.sqrt(np.trace(INERTIA) / 3)), friction=OPTIONS.friction,
    stiffness=OPTIONS.stiffness, step=OPTIONS.step,
)  # fmt: skip
MOTIONS = initial_motions(7, WORLD.step, WORLD.gyration)


def around(seed: int, count: int = 24) -> Contacts:
    """Contacts on the sides of a box of 8 cm, in numbers that float32 has: the kernel reads float32. Along the axes, as
    no other normal has a length of exactly 1 in float32, and solver and reference differ in what they make of that."""
    rng = np.random.default_rng(seed)
    normals = np.concatenate([np.eye(3), -np.eye(3)])[rng.integers(6, size=count)]
    points = np.where(normals == 0, rng.uniform(-0.04, 0.04, (count, 3)), 0.04 * normals)
    parts = (points, normals, -1e-4 + 2e-4 * rng.normal(size=count), rng.uniform(0.5, 1.5, count))
    return Contacts(*(part.astype(np.float32).astype(float) for part in parts))


def run64(contacts: Contacts, passes: int = PASSES) -> tuple[Any, Any, Any]:
    """Motions at the end (M, 6), losses (M,), dL/drho (N,)."""
    n, m = len(contacts.points), len(MOTIONS)
    with wp.ScopedDevice("cpu"):
        loss, end = wp.zeros((1, m), dtype=wp.float64), wp.zeros((1, m), dtype=contact64.vec6d)
        gradient = wp.zeros((1, n), dtype=wp.float64)
        inputs = [
            physics64(OPTIONS, INERTIA, WORLD.gyration, radius=0.2), wp.array(MOTIONS, dtype=contact64.vec6d), passes,
            wp.ones(1, dtype=wp.int32), wp.zeros(1, dtype=wp.int32), wp.zeros(1, dtype=wp.float32),
            wp.ones(1, dtype=wp.float32), wp.array([n], dtype=wp.int32),
            wp.array(contacts.points[None], dtype=wp.vec3), wp.array(contacts.normals[None], dtype=wp.vec3),
            wp.array(contacts.distances[None], dtype=wp.float32), wp.array(contacts.weights[None], dtype=wp.float32),
        ]  # fmt: skip
        wp.launch(contact64.direct64, dim=(1, m), inputs=[*inputs, loss, end, gradient])
        return end.numpy()[0], loss.numpy()[0], gradient.numpy()[0]


def adjoint(contacts: Contacts, s0: Any) -> Any:
    """dL/drho (N,) of one simulation in NumPy: y solves the last system against dL/ds, g = k w (j + slip) . y."""
    before = reference.direct(contacts, s0, WORLD, PASSES - 1)
    a = WORLD.mass.copy()
    rows = list(zip(contacts.points, contacts.normals, contacts.distances, contacts.weights, strict=True))
    for p, n, rho, w in rows:
        u = reference.motion_at(before, p)
        c, tangent = n @ u - rho, u - (n @ u) * n
        if c > 0:
            k = WORLD.stiffness * w
            a += k * np.outer(reference.row(n, p), reference.row(n, p))
            slide = min(k, k * WORLD.friction * c / max(float(np.linalg.norm(tangent)), 1e-9))
            for e in np.eye(3):
                a += slide * np.outer(reference.row(e - (n @ e) * n, p), reference.row(e - (n @ e) * n, p))
    s = reference.direct(contacts, s0, WORLD, PASSES)
    x, turn = s[:3], WORLD.gyration * s[3:]
    lengths = [np.sqrt(v @ v + reference.SMOOTH**2) for v in (x, turn)]
    y = np.linalg.solve(a, np.concatenate([x / lengths[0], WORLD.gyration * turn / lengths[1]]) / WORLD.step)
    found = np.zeros(len(rows))
    for i, (p, n, rho, w) in enumerate(rows):
        u = reference.motion_at(s, p)
        c, tangent = n @ u - rho, u - (n @ u) * n
        if c > 0:
            slip = float(np.linalg.norm(tangent))
            push = n + (WORLD.friction * tangent / slip if WORLD.friction * c < slip else 0.0)
            found[i] = WORLD.stiffness * w * reference.row(push, p) @ y
    return found


@pytest.mark.parametrize("seed", range(5))
def test_the_float64_step_ends_where_the_reference_ends(seed: int) -> None:
    """Both solve the same 6 x 6 systems in float64, one by Cholesky: condition numbers of 1e3 leave 1e-12."""
    contacts = around(seed)
    end, loss, _ = run64(contacts)
    expected = np.array([reference.direct(contacts, s0, WORLD, PASSES) for s0 in MOTIONS])
    np.testing.assert_allclose(end, expected, rtol=1e-9, atol=1e-9 * WORLD.step)
    np.testing.assert_allclose(loss, [reference.loss(s, WORLD) for s in expected], rtol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_the_float64_adjoint_is_that_of_the_reference(seed: int) -> None:
    contacts = around(seed)
    expected = np.mean([adjoint(contacts, s0) for s0 in MOTIONS], axis=0)
    np.testing.assert_allclose(run64(contacts)[2], expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())


def test_the_float32_kernel_differs_from_it_by_what_float32_is() -> None:
    """Numbers of 6e-8 relative, condition numbers up to 1e3: a few 1e-4 at most, and not nothing."""
    contacts = around(0)
    exact = run64(contacts)[2]
    off = np.abs(kernel_gradient("direct", contacts, WORLD) - exact).max() / np.abs(exact).max()
    assert 1e-9 < off < 1e-3


@pytest.fixture(scope="module")
def pair() -> Pair:
    backend.start()
    return pair_of(hand_from_path("barrett"), object_from_path("block"), FIDELITIES["draft"], "cpu")


def evaluated(simulation: Simulation, pair: Pair) -> tuple[Any, Any]:
    """Losses and gradients of two starts at the schedule's first row."""
    model, obj = pair.hand.model, pair.coarse.obj.model
    state = sample_starts(model, obj, simulation, seed=3, batch=0, indices=range(2), each=1)
    simulation.set_schedule(coarse_schedule(FIDELITIES["draft"]))
    simulation.set_state(state)
    simulation.record_evaluation()
    simulation.run()
    simulation.run()  # twice: what is summed up must be cleared in between
    return simulation.loss.numpy()[:2].copy(), simulation.gradient.numpy()[:2].copy()


def test_a_simulation_with_the_float64_step_sees_the_same_losses_and_gradients(pair: Pair) -> None:
    """Equal but for the rounding of float32 in all else: forces of 1e2 on the hand are summed from 1e3 points."""
    capacity = 12
    loss, gradient = evaluated(pair.simulation(pair.coarse, capacity), pair)
    loss64, gradient64 = evaluated(solving_in_64(pair).simulation(pair.coarse, capacity), pair)
    np.testing.assert_allclose(loss64, loss, rtol=1e-3)
    np.testing.assert_allclose(gradient64, gradient, atol=1e-3 * np.abs(gradient).max())
    assert np.any(loss64 != loss)


def test_grasps_can_be_made_with_it() -> None:
    little = FIDELITIES["draft"].model_copy(update={"coarse_iterations": 12, "fine_iterations": 5})
    hand, obj = hand_from_path("barrett"), object_from_path("block")
    found = _run(hand, obj, 2, 0, turn=Turn("", "", little, solving_in_64), threads=2, device="cpu")
    assert np.isfinite(found.grasp.hand_pose).all()
