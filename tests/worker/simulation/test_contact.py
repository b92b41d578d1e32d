"""The contact kernels against the float64 reference, and the physics they must keep."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from graspd.studies.stability.gradients import SOLVERS, reference_gradient, run_kernel
from graspd.worker.simulation import reference
from graspd.worker.simulation.model import NEAR_GAP, initial_motions
from graspd.worker.simulation.reference import Contacts, World
from tests.worker.models import unit_vectors

END_TOLERANCE = 2e-6  # float32 solves of 6 x 6 systems with condition numbers up to 1e3, motions of 1e-3 m
#: Cosine between the kernel's adjoint and central differences: contacts that switch on or off within the difference,
#: and the fixed slip direction, are what differs.
COSINE = 0.97
INERTIA = np.diag([8e-4, 6e-4, 4e-4])
WORLD = World(inertia=INERTIA, gyration=float(np.sqrt(np.trace(INERTIA) / 3)))
MOTIONS = initial_motions(7, WORLD.step, WORLD.gyration)
run = partial(run_kernel, near_gap=NEAR_GAP, lane=5)
EACH = pytest.mark.parametrize("name", SOLVERS)


def ring(rng: np.random.Generator, count: int = 24, gap: float = -1e-4, spread: float = 2e-4) -> Contacts:
    """Contacts all around a ball of 4 cm."""
    normals = unit_vectors(rng, count)
    return Contacts(0.04 * normals, normals, gap + spread * rng.normal(size=count), rng.uniform(0.5, 1.5, count))


@EACH
def test_the_step_ends_where_the_float64_reference_ends(name: str) -> None:
    rng = np.random.default_rng(1)
    scale = np.repeat([1, WORLD.gyration], 3)
    for _ in range(5):
        contacts = ring(rng)
        end, _, _ = run(name, contacts, WORLD)
        expected = SOLVERS[name][1](contacts, MOTIONS, WORLD)
        np.testing.assert_allclose(end * scale, expected * scale, atol=END_TOLERANCE)


@EACH
def test_gradient_agrees_with_central_differences_of_reference(name: str) -> None:
    rng = np.random.default_rng(2)
    cosines = []
    for _ in range(5):
        contacts = ring(rng, count=8, gap=-3e-4, spread=1e-4)
        _, _, gradient = run(name, contacts, WORLD)
        numeric = reference_gradient(name, contacts, WORLD)
        cosines.append(gradient @ numeric / np.linalg.norm(gradient) / np.linalg.norm(numeric))
    assert np.median(cosines) > COSINE, cosines


def test_the_list_of_near_contacts_and_the_lane_change_nothing() -> None:
    rng = np.random.default_rng(7)
    for spread in (2e-4, 2e-2):
        contacts = ring(rng, count=40, gap=1e-3, spread=spread)
        whole = run("direct", contacts, WORLD, leak=0.1, near_gap=1.0, lane=1)
        listed = run("direct", contacts, WORLD, leak=0.1)
        for found, expected in zip(listed, whole, strict=True):
            np.testing.assert_array_equal(found, expected)


def test_a_free_object_keeps_its_motion() -> None:
    far = Contacts(np.array([[0, 0, 0.04]]), np.array([[0, 0, 1.0]]), np.array([0.01]), np.ones(1))
    for name in SOLVERS:
        end, loss, gradient = run(name, far, WORLD)
        np.testing.assert_allclose(end, MOTIONS, atol=1e-9)
        assert np.all(gradient == 0)
        assert loss[0] < 0.05, "an object at rest that nothing touches stays at rest, up to the smoothing"


def test_friction_never_leaves_the_cone_sticks_and_slips() -> None:
    rng = np.random.default_rng(3)
    stuck = slid = 0
    for friction in (0.1, 0.8, 3.0):
        world, contacts = replace(WORLD, friction=friction), ring(rng)
        normal, slip = np.moveaxis(reference.gauss_seidel(contacts, MOTIONS, world)[1], -1, 0)
        assert np.all(slip <= friction * normal * (1 + 1e-12))
        sticks = slip < friction * normal * (1 - 1e-9)
        stuck += np.sum((slip > 0) & sticks)
        slid += np.sum((normal > 0) & ~sticks)
    assert stuck > 0 and slid > 0


def test_an_object_between_fingers_sticks_or_slides_by_friction() -> None:
    points = np.array([[0.03, 0, 0], [-0.03, 0, 0]])
    squeeze = Contacts(points, points / 0.03, np.full(2, -1e-3), np.full(2, 50.0))
    for name in SOLVERS:
        rough, smooth = replace(WORLD, friction=2.0), replace(WORLD, friction=1e-6)
        along_y = 3  # motions: rest, +x, -x, +y, ...
        # One sweep leaves part of the slip that the second contact causes at the first.
        assert abs(run(name, squeeze, rough)[0][along_y, 1]) < 0.35 * WORLD.step
        assert abs(run(name, squeeze, smooth)[0][along_y, 1]) > 0.9 * WORLD.step


def test_one_contact_gives_object_the_momentum_of_its_impulse() -> None:
    """Off-centre and without friction: M s = lambda (n, p x n) with lambda = -C / w, in closed form."""
    point, normal, depth = np.array([0.04, 0.01, -0.02]), np.array([0.0, 0.6, 0.8]), 1e-3
    single = Contacts(point[None], normal[None], np.array([-depth]), np.ones(1))
    world = replace(WORLD, friction=1e-9)
    arm = np.cross(point, normal)
    w = 1.0 + arm @ np.linalg.inv(INERTIA) @ arm
    impulse = -depth / w
    expected = np.concatenate([impulse * normal, np.linalg.inv(INERTIA) @ (impulse * arm)])
    np.testing.assert_allclose(run("gauss_seidel", single, world)[0][0], expected, rtol=1e-5, atol=1e-9)


def test_a_balanced_grasp_leaves_the_object_at_rest_without_nan() -> None:
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    balanced = Contacts(0.04 * axes, axes, np.full(6, -5e-4), np.ones(6))
    for name in ("direct", "jacobi"):
        end, _, _ = run(name, balanced, WORLD)
        np.testing.assert_allclose(end[0], 0, atol=1e-8)
    touching = Contacts(np.zeros((3, 3)), np.eye(3), np.zeros(3), np.ones(3))
    for name in SOLVERS:
        for part in run(name, touching, WORLD, leak=0.1):
            assert np.all(np.isfinite(part))


@EACH
def test_the_one_sided_leak_only_draws_free_points_nearer(name: str) -> None:
    free = ring(np.random.default_rng(5), gap=5e-3, spread=1e-4)
    one = run(name, free, WORLD, leak=0.1)[2]
    two = run(name, free, WORLD, leak=0.1, one_sided=False)[2]
    # Descending a positive dL/drho shortens the distance.
    assert np.all(one >= 0) and one.max() > 0
    assert np.abs(two).max() < 0.1 * one.max(), "two-sided: opposite velocities cancel where nothing touches"
