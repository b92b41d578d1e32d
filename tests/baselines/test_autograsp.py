"""Autograsp: each joint stops when a link it moves touches, and only then."""

import numpy as np
import pytest
import trimesh

from graspd.baselines.autograsp import kernels
from graspd.baselines.autograsp.method import TOUCH_M, HandCloser
from graspd.baselines.common import load_pair
from graspd.worker.simulation.data import HandState
from tests.worker.models import object_from_mesh, two_finger_hand

#: Hand points are 9 mm apart on these fingers: a curved link may come this much nearer between two of them [m].
SAMPLED = 1.5e-3


def closer_on(*box: float) -> HandCloser:
    obj = object_from_mesh(trimesh.creation.box(box))
    return HandCloser(load_pair(two_finger_hand(), obj, "cpu", kernels), 1)


def distances(closer: HandCloser, state: HandState) -> np.ndarray:
    closer.data.set_state(state)
    closer._measure()
    return closer.near.numpy()


def closed(box: tuple[float, float, float], shift: float = 0.0) -> tuple[np.ndarray, list[int], np.ndarray]:
    """Close two fingers, 80 mm apart, on a box in front of the palm.
    Return joint positions, why each dof stopped, and each body's distance from the box [m]."""
    closer = closer_on(*box)
    pivot = np.array([[shift, 0.0, -0.06]])
    found = closer.close(HandState(pivot, np.array([[1.0, 0, 0, 0]]), np.zeros((1, 2))))
    return found.q[0], closer.stopped.numpy()[0].tolist(), distances(closer, found)[0]


def test_each_finger_stops_at_its_own_first_contact() -> None:
    q, stopped, distance = closed((0.03, 0.05, 0.05), shift=0.005)
    assert stopped == [1, 1] and np.all(distance[1:] < TOUCH_M)
    assert np.all(distance[1:] > -TOUCH_M)
    # The box is nearer to one finger: the other went on after that one had stopped.
    assert abs(q[0] - q[1]) > 0.1


def test_a_finger_that_meets_nothing_closes_to_its_limit() -> None:
    q, _, distance = closed((0.01, 0.01, 0.01), shift=0.2)
    assert np.all(distance > 0.02) and np.all(q > 0.2)


@pytest.mark.parametrize("thickness", [1e-3, 1e-4])
def test_nothing_is_passed_through_however_thin(thickness: float) -> None:
    q, stopped, distance = closed((thickness, 0.06, 0.06))
    assert stopped == [1, 1] and np.all(distance[1:] > -SAMPLED)
    # Symmetric: both fingers ended on their own side.
    assert np.allclose(q[0], q[1], atol=0.02)


def test_the_approach_ends_at_the_standoff() -> None:
    closer = closer_on(0.03, 0.03, 0.03)
    start = HandState(np.array([[0.0, 0.0, -0.15]]), np.array([[1.0, 0, 0, 0]]), np.zeros((1, 2)))
    there = closer.approach(start, 0.004)
    assert distances(closer, there).min() == pytest.approx(0.004, abs=3e-4) and there.pivot[0, 2] > -0.1
