"""DexGraspNet's energies and annealing, against values that follow from their formulas."""

import numpy as np
import pytest
import trimesh
import warp as wp

from graspd.baselines.common import load_pair
from graspd.baselines.dfc import kernels
from graspd.baselines.dfc.method import DISTANCE, Descent, sample_starts
from graspd.worker.execution_context import DEFAULT_CONTEXT
from graspd.worker.planners.threads import StepCounter
from graspd.worker.simulation.data import HandState
from tests.worker.models import object_from_mesh, two_finger_hand

BOX = object_from_mesh(trimesh.creation.box((0.05, 0.05, 0.05)))
WEIGHTS = np.array([1.0, 100.0, 100.0, 10.0, 1.0])


def descent(pivot: tuple[float, float, float] = (0.0, 0.0, -0.2), q: tuple[float, float] = (0.0, 0.0)) -> Descent:
    pair = load_pair(two_finger_hand(), BOX, "cpu", kernels)
    return Descent(pair, HandState(np.array([pivot]), np.array([[1.0, 0, 0, 0]]), np.array([q])), [[0, 0, 0]])


def evaluated(found: Descent, pivot: tuple[float, float, float], q: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    found.proposal.set_state(HandState(np.array([pivot]), np.array([[1.0, 0, 0, 0]]), np.array([q])))
    found.new_terms.zero_()
    for _, launch in found.launches.named_commands()[1:-2]:
        launch.launch()
    return found.new_terms.numpy()[0].astype(float)


def contacts_at(points: list[list[float]]) -> np.ndarray:
    """Energies with the four contacts at these points of space, on the palm of a hand far away."""
    pivot = (0.0, 0.0, -0.2)
    found = descent(pivot)
    found.candidate_body.zero_()
    places = np.zeros((len(found.candidates), 3))
    places[:4] = np.array(points) - pivot
    found.candidate_position.assign(places)
    found.new_contact.assign([[0, 1, 2, 3]])
    return evaluated(found, pivot)


@pytest.mark.parametrize(
    ("points", "closure", "distance"),
    [
        # In balance.
        ([[0.025, 0, 0], [-0.025, 0, 0], [0, 0.025, 0], [0, -0.025, 0]], 0.0, 0.0),
        # On one face: |4 n|^2 = 16, and no torque about the middle.
        ([[0.025, 0.01, 0], [0.025, -0.01, 0], [0.025, 0, 0.01], [0.025, 0, -0.01]], 16.0, None),
        # Two couples of arm 0.02 m about z: |2 * 0.02|^2.
        ([[0.025, 0.01, 0], [-0.025, -0.01, 0], [0.025, 0.01, 0], [-0.025, -0.01, 0]], 0.04**2, None),
        # Off the surface on either side of it.
        ([[0.028, 0, 0], [-0.026, 0, 0], [0, 0.023, 0], [0, -0.025, 0]], None, 0.006),
    ],
)
def test_energies_of_contacts(points: list[list[float]], closure: float | None, distance: float | None) -> None:
    terms = contacts_at(points)
    assert closure is None or terms[0] == pytest.approx(closure, rel=1e-3, abs=1e-6)
    assert distance is None or terms[1] == pytest.approx(distance, abs=1e-6)


@pytest.mark.parametrize("q", [(0.1, 0.3), (-0.35, 0.25), (1.3, 1.3)])
def test_the_gradient_is_the_difference_quotient_of_the_energy(q: tuple[float, float]) -> None:
    """Fingers in the box, once beyond a joint limit. Relative 3 %: samples enter pieces one by one.

    Force closure is left out of the quotient: its gradient takes normals as constant, and its torques are small here.
    """
    found, pivot, step = descent(), (0.004, 0.003, -0.035), 2e-5
    evaluated(found, pivot, q)
    gradient = found.proposal.gradient.numpy()[0].astype(float)
    quotient = []
    for column in (0, 1, 2, 6, 7):
        ends = []
        for sign in (1, -1):
            moved, turned = list(pivot), list(q)
            (moved if column < 3 else turned)[column % 3] += sign * step
            ends.append(evaluated(found, tuple(moved), tuple(turned))[1:] @ WEIGHTS[1:])  # type: ignore[arg-type]
        quotient.append((ends[0] - ends[1]) / (2 * step))
    np.testing.assert_allclose(gradient[[0, 1, 2, 6, 7]], quotient, rtol=0.03, atol=0.03 * np.abs(quotient).max())


@wp.kernel(enable_backward=False)
def _schedule(iteration_in: wp.array[wp.int32], rise_in: float, uniform_in: wp.array[float], out: wp.array[wp.vec3]):
    i = wp.tid()
    cold = kernels.temperature(iteration_in[i])
    accepted = kernels.is_accepted(rise_in, cold, uniform_in[i])
    out[i] = wp.vec3(kernels.step_size(iteration_in[i]), cold, float(accepted))


def probed(iteration: list[int], uniform: np.ndarray, rise: float = 0.0) -> np.ndarray:
    """(3, n) size of a step, temperature, and whether the rise is accepted."""
    given = [wp.array(iteration, dtype=wp.int32, device="cpu"), rise, wp.array(uniform, dtype=float, device="cpu")]
    found = wp.zeros(len(iteration), dtype=wp.vec3, device="cpu")
    wp.launch(_schedule, len(iteration), inputs=given, outputs=[found], device="cpu")
    return found.numpy().T


def test_steps_and_temperature_decay_every_50_and_30_iterations() -> None:
    size, cold, _ = probed([0, 29, 30, 49, 50, 5999], np.zeros(6))
    np.testing.assert_allclose(size, [5e-3, 5e-3, 5e-3, 5e-3, 4.75e-3, 5e-3 * 0.95**119], rtol=1e-4)
    np.testing.assert_allclose(cold, [18, 18, 17.1, 17.1, 17.1, 18 * 0.95**199], rtol=1e-4)


def test_a_fall_is_accepted_and_a_rise_with_its_boltzmann_factor() -> None:
    """20,000 draws at a rise of T: a share of 1/e, standard error 0.3 points."""
    n = 20_000
    uniform = np.random.default_rng(5).random(n)
    assert probed([0] * n, uniform, -1e-3)[2].all()
    assert probed([0] * n, uniform, 18.0)[2].mean() == pytest.approx(np.exp(-1), abs=0.015)
    assert probed([3000] * n, uniform, 18.0)[2].mean() == 0


def test_annealing_ends_at_a_lower_energy_than_it_began() -> None:
    found = descent()
    tell = StepCounter(1, DEFAULT_CONTEXT)
    found.run(1, tell)
    before = found.energies()[0] @ WEIGHTS
    found.run(1500, tell)
    assert found.energies()[0] @ WEIGHTS < 0.3 * before and 0 < found.taken.numpy()[0] <= 1501


def test_starts_look_at_the_hull_from_the_given_distance() -> None:
    found = sample_starts(two_finger_hand(), BOX, seed=0, batch=0, indices=range(40))
    signed = trimesh.proximity.signed_distance(trimesh.creation.box((0.05, 0.05, 0.05)), found.pivot)
    assert np.all(-signed <= DISTANCE[1] + 1e-9)
    # Tilted by 30 degrees, the palm is at least cos 30 of the least distance off the face.
    assert np.all(-signed >= np.cos(np.pi / 6) * DISTANCE[0] - 1e-9)
