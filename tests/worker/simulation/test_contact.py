"""The contact kernels against the float64 reference, and the physics they must keep."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import warp as wp

from graspd.worker.simulation import reference
from graspd.worker.simulation.kernels import contact
from graspd.worker.simulation.model import NEAR_GAP, initial_motions
from graspd.worker.simulation.reference import Contacts, World

END_TOLERANCE = 2e-6  # float32 solves of 6 x 6 systems with condition numbers up to 1e3, motions of 1e-3 m
#: Cosine between the kernel's adjoint and central differences: contacts that switch on or off within the difference,
#: and the fixed slip direction, are what differs.
COSINE = 0.97
#: Passes of the direct and Jacobi solvers: the direct solve converges in 4.
PASSES = 12
INERTIA = np.diag([8e-4, 6e-4, 4e-4])
WORLD = World(inertia=INERTIA, gyration=float(np.sqrt(np.trace(INERTIA) / 3)))


def ring(rng: np.random.Generator, count: int = 24, gap: float = -1e-4, spread: float = 2e-4) -> Contacts:
    """Contacts all around a ball of 4 cm."""
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Contacts(0.04 * normals, normals, gap + spread * rng.normal(size=count), rng.uniform(0.5, 1.5, count))


def physics(world: World, *, leak: float = 0.0, one_sided: bool = True, near_gap: float = NEAR_GAP) -> Any:
    out = contact.Physics()
    out.mass = contact.mat66(*world.mass.ravel().tolist())
    out.inverse_mass = contact.mat66(*np.linalg.inv(world.mass).ravel().tolist())
    out.gyration, out.friction, out.stiffness = world.gyration, world.friction, world.stiffness
    out.leak, out.leak_length, out.one_sided, out.step = leak, 0.02, int(one_sided), world.step
    out.radius = 0.2
    out.near_gap = near_gap
    return out


def run(
    kernel: Any,
    contacts: Contacts,
    world: World,
    *,
    passes: int = PASSES,
    leak: float = 0.0,
    one_sided: bool = True,
    near_gap: float = NEAR_GAP,
    lane: int = 5,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Motions at the end (M, 6), losses (M,), dL/drho (N,)."""
    motions = initial_motions(7, world.step, world.gyration)
    n, m = len(contacts.points), len(motions)
    with wp.ScopedDevice("cpu"):
        loss, end = wp.zeros((1, m), dtype=wp.float32), wp.zeros((1, m), dtype=contact.vec6)
        gradient = wp.zeros((1, n), dtype=wp.float32)
        constants = physics(world, leak=leak, one_sided=one_sided, near_gap=near_gap)
        given = [
            wp.ones(1, dtype=wp.int32),
            wp.zeros(1, dtype=wp.int32),
            wp.array([world.dilation], dtype=wp.float32),
            wp.ones(1, dtype=wp.float32),
            wp.array([n], dtype=wp.int32),
            wp.array(contacts.points[None], dtype=wp.vec3),
            wp.array(contacts.normals[None], dtype=wp.vec3),
            wp.array(contacts.distances[None], dtype=wp.float32),
            wp.array(contacts.weights[None], dtype=wp.float32),
        ]
        inputs = [constants, wp.array(motions, dtype=contact.vec6), passes, *given]
        if kernel is contact.direct:
            listed = np.flatnonzero(contacts.distances - world.dilation <= near_gap)
            near = np.concatenate([listed, np.zeros(n - len(listed), int)])
            adjoint = wp.zeros((1, m), dtype=contact.vec6)
            inputs += [wp.array([len(listed)], dtype=wp.int32), wp.array(near[None], dtype=wp.int32)]
            wp.launch(kernel, dim=(1, m), inputs=inputs, outputs=[loss, end, adjoint])
            inputs = [constants, lane, *given, end, adjoint]
            wp.launch(contact.direct_gradient, dim=(1, -(-n // lane)), inputs=inputs, outputs=[gradient])
        else:
            states = wp.zeros((1, m, max(n, passes)), dtype=contact.vec6)
            wp.launch(kernel, dim=(1, m), inputs=inputs, outputs=[states, loss, end, gradient])
        return end.numpy()[0].astype(float), loss.numpy()[0].astype(float), gradient.numpy()[0].astype(float)


def numeric_gradient(solver: Any, contacts: Contacts, world: World, step: float = 1e-9) -> np.ndarray:
    """dL/drho (N,) by central differences of the reference, all at once."""
    steps = step * np.eye(len(contacts.points))[:, None]
    motions = initial_motions(7, world.step, world.gyration)

    def losses(distances: np.ndarray) -> np.ndarray:
        return np.mean(reference.loss(solver(replace(contacts, distances=distances), motions, world), world), axis=-1)

    return (losses(contacts.distances + steps) - losses(contacts.distances - steps)) / (2 * step)


SOLVERS = {
    "direct": (contact.direct, lambda c, s0, w: reference.direct(c, s0, w, PASSES)),
    "gauss_seidel": (contact.gauss_seidel, lambda c, s0, w: reference.gauss_seidel(c, s0, w)[0]),
    "jacobi": (contact.jacobi, lambda c, s0, w: reference.jacobi(c, s0, w, PASSES)),
}


@pytest.mark.parametrize("name", SOLVERS)
def test_the_step_ends_where_the_float64_reference_ends(name: str) -> None:
    kernel, solver = SOLVERS[name]
    rng = np.random.default_rng(1)
    for _ in range(5):
        contacts = ring(rng)
        end, _, _ = run(kernel, contacts, WORLD)
        expected = solver(contacts, initial_motions(7, WORLD.step, WORLD.gyration), WORLD)
        scale = np.array([1, 1, 1, WORLD.gyration, WORLD.gyration, WORLD.gyration])
        np.testing.assert_allclose(end * scale, expected * scale, atol=END_TOLERANCE)


@pytest.mark.parametrize("name", SOLVERS)
def test_gradient_agrees_with_central_differences_of_reference(name: str) -> None:
    kernel, solver = SOLVERS[name]
    rng = np.random.default_rng(2)
    cosines = []
    for _ in range(5):
        contacts = ring(rng, count=8, gap=-3e-4, spread=1e-4)
        _, _, gradient = run(kernel, contacts, WORLD)
        numeric = numeric_gradient(solver, contacts, WORLD)
        cosines.append(gradient @ numeric / np.linalg.norm(gradient) / np.linalg.norm(numeric))
    assert np.median(cosines) > COSINE, cosines


def test_the_list_of_near_contacts_and_the_lane_change_nothing() -> None:
    rng = np.random.default_rng(7)
    for spread in (2e-4, 2e-2):
        contacts = ring(rng, count=40, gap=1e-3, spread=spread)
        whole = run(contact.direct, contacts, WORLD, leak=0.1, near_gap=1.0, lane=1)
        listed = run(contact.direct, contacts, WORLD, leak=0.1)
        for found, expected in zip(listed, whole, strict=True):
            np.testing.assert_array_equal(found, expected)


def test_a_free_object_keeps_its_motion() -> None:
    far = Contacts(np.array([[0, 0, 0.04]]), np.array([[0, 0, 1.0]]), np.array([0.01]), np.ones(1))
    for kernel, _ in SOLVERS.values():
        end, loss, gradient = run(kernel, far, WORLD)
        np.testing.assert_allclose(end, initial_motions(7, WORLD.step, WORLD.gyration), atol=1e-9)
        assert np.all(gradient == 0)
        assert loss[0] < 0.05, "an object at rest that nothing touches stays at rest, up to the smoothing"


def test_friction_never_leaves_the_cone_sticks_and_slips() -> None:
    rng = np.random.default_rng(3)
    stuck = slid = 0
    for friction in (0.1, 0.8, 3.0):
        world, contacts = replace(WORLD, friction=friction), ring(rng)
        motions = initial_motions(7, world.step, world.gyration)
        normal, slip = np.moveaxis(reference.gauss_seidel(contacts, motions, world)[1], -1, 0)
        assert np.all(slip <= friction * normal * (1 + 1e-12))
        sticks = slip < friction * normal * (1 - 1e-9)
        stuck += np.sum((slip > 0) & sticks)
        slid += np.sum((normal > 0) & ~sticks)
    assert stuck > 0 and slid > 0


def test_an_object_between_fingers_sticks_or_slides_by_friction() -> None:
    points = np.array([[0.03, 0, 0], [-0.03, 0, 0]])
    squeeze = Contacts(points, points / 0.03, np.full(2, -1e-3), np.full(2, 50.0))
    for kernel, _ in SOLVERS.values():
        rough, smooth = replace(WORLD, friction=2.0), replace(WORLD, friction=1e-6)
        along_y = 3  # motions: rest, +x, -x, +y, ...
        # One sweep leaves part of the slip that the second contact causes at the first.
        assert abs(run(kernel, squeeze, rough)[0][along_y, 1]) < 0.35 * WORLD.step
        assert abs(run(kernel, squeeze, smooth)[0][along_y, 1]) > 0.9 * WORLD.step


def test_one_contact_gives_object_the_momentum_of_its_impulse() -> None:
    """Off-centre and without friction: M s = lambda (n, p x n) with lambda = -C / w, in closed form."""
    point, normal, depth = np.array([0.04, 0.01, -0.02]), np.array([0.0, 0.6, 0.8]), 1e-3
    single = Contacts(point[None], normal[None], np.array([-depth]), np.ones(1))
    world = replace(WORLD, friction=1e-9)
    arm = np.cross(point, normal)
    w = 1.0 + arm @ np.linalg.inv(INERTIA) @ arm
    impulse = -depth / w
    expected = np.concatenate([impulse * normal, np.linalg.inv(INERTIA) @ (impulse * arm)])
    end = run(contact.gauss_seidel, single, world)[0][0]
    np.testing.assert_allclose(end, expected, rtol=1e-5, atol=1e-9)


def test_a_balanced_grasp_leaves_the_object_at_rest_without_nan() -> None:
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    balanced = Contacts(0.04 * axes, axes, np.full(6, -5e-4), np.ones(6))
    for kernel in (contact.direct, contact.jacobi):
        end, _, _ = run(kernel, balanced, WORLD)
        np.testing.assert_allclose(end[0], 0, atol=1e-8)
    touching = Contacts(np.zeros((3, 3)), np.eye(3), np.zeros(3), np.ones(3))
    for kernel, _ in SOLVERS.values():
        for part in run(kernel, touching, WORLD, leak=0.1):
            assert np.all(np.isfinite(part))


def test_direct_solve_does_not_depend_on_the_order_of_contacts() -> None:
    rng = np.random.default_rng(4)
    contacts = ring(rng)
    order = rng.permutation(len(contacts.points))
    shuffled = Contacts(*(a[order] for a in (contacts.points, contacts.normals, contacts.distances, contacts.weights)))
    end, _, gradient = run(contact.direct, contacts, WORLD)
    end2, _, gradient2 = run(contact.direct, shuffled, WORLD)
    np.testing.assert_allclose(end, end2, atol=1e-7)
    np.testing.assert_allclose(gradient[order], gradient2, atol=1e-3 * np.abs(gradient).max())


@pytest.mark.parametrize("name", SOLVERS)
def test_the_one_sided_leak_only_draws_free_points_nearer(name: str) -> None:
    kernel, _ = SOLVERS[name]
    rng = np.random.default_rng(5)
    free = ring(rng, gap=5e-3, spread=1e-4)
    one = run(kernel, free, WORLD, leak=0.1)[2]
    two = run(kernel, free, WORLD, leak=0.1, one_sided=False)[2]
    # Descending a positive dL/drho shortens the distance.
    assert np.all(one >= 0) and one.max() > 0
    assert np.abs(two).max() < 0.1 * one.max(), "two-sided: opposite velocities cancel where nothing touches"
