"""Autograsp: each joint stops when a link it moves touches, and only then."""

import numpy as np
import pytest
import trimesh

from graspd.baselines.autograsp import kernels
from graspd.baselines.autograsp.method import TOUCH_M, ClosedHands, HandCloser
from graspd.baselines.common import load_pair
from graspd.worker.simulation.data import HandState
from tests.worker.models import object_from_mesh, two_finger_hand

#: Hand points are 9 mm apart on these fingers: a curved link may come this much nearer between two of them [m].
SAMPLED = 1.5e-3


def closer_on(*box: float) -> HandCloser:
    obj = object_from_mesh(trimesh.creation.box(box))
    return HandCloser(load_pair(two_finger_hand(), obj, "cpu", kernels), 1)


def closed(box: tuple[float, float, float], shift: float = 0.0) -> tuple[ClosedHands, np.ndarray]:
    """Two fingers, 80 mm apart, closed on a box in front of the palm; and each body's distance from it."""
    closer = closer_on(*box)
    pivot = np.array([[shift, 0.0, -0.06]])
    found = closer.close(HandState(pivot, np.array([[1.0, 0, 0, 0]]), np.zeros((1, 2))))
    return found, closer.distances(found.state)


def test_each_finger_stops_at_its_own_first_contact() -> None:
    found, distance = closed((0.03, 0.05, 0.05), shift=0.005)
    assert found.stopped.tolist() == [[1, 1]] and np.all(distance[0, 1:] < TOUCH_M)
    assert np.all(distance[0, 1:] > -TOUCH_M)
    # The box is nearer to one finger: the other went on after that one had stopped.
    assert abs(found.state.q[0, 0] - found.state.q[0, 1]) > 0.1


def test_a_finger_that_meets_nothing_closes_to_its_limit() -> None:
    found, distance = closed((0.01, 0.01, 0.01), shift=0.2)
    assert np.all(distance[0] > 0.02) and np.all(found.state.q[0] > 0.2)


@pytest.mark.parametrize("thickness", [1e-3, 1e-4])
def test_nothing_is_passed_through_however_thin(thickness: float) -> None:
    found, distance = closed((thickness, 0.06, 0.06))
    assert found.stopped.tolist() == [[1, 1]] and np.all(distance[0, 1:] > -SAMPLED)
    # Symmetric: both fingers ended on their own side.
    assert np.allclose(found.state.q[0, 0], found.state.q[0, 1], atol=0.02)


def test_the_approach_ends_at_the_standoff() -> None:
    closer = closer_on(0.03, 0.03, 0.03)
    start = HandState(np.array([[0.0, 0.0, -0.15]]), np.array([[1.0, 0, 0, 0]]), np.zeros((1, 2)))
    there = closer.approach(start, 0.004)
    assert closer.distances(there).min() == pytest.approx(0.004, abs=3e-4) and there.pivot[0, 2] > -0.1
