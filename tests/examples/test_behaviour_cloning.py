"""The policy cloned from episodes: its network, and what it makes of demonstrations."""

import numpy as np
import pytest

from examples.behaviour_cloning.policy import Demonstration, Network, most_common, train
from graspd.service.model.transforms import IDENTITY_POSE, compose, quat_from_axis_angle
from graspd.worker.episodes.episode import Episode, EpisodeOutcome

UP = np.array([0.0, 0.0, 1.0])


def test_the_gradient_is_that_of_finite_differences() -> None:
    rng = np.random.default_rng(0)
    network, x, y = Network(4, 3, rng), rng.normal(size=(8, 4)), rng.normal(size=(8, 3))

    def loss() -> float:
        return float(((network(x) - y) ** 2).mean())

    network.learn(x, y, 0.0)
    for value, (mean, _) in zip((*network.weights, *network.biases), network._moments, strict=True):
        place = np.unravel_index(int(np.abs(mean).argmax()), value.shape)
        before, sides = value[place], []
        for step in (1e-6, -1e-6):
            value[place] = before + step
            sides.append(loss())
        value[place] = before
        # The first step of Adam's mean is a tenth of the gradient; differences of 1e-6 keep six digits.
        assert (sides[0] - sides[1]) / 2e-6 == pytest.approx(10 * mean[place], rel=1e-4)


def demonstration(yaw: float, side: float) -> Demonstration:
    """A root that descends beside an object turned by `yaw`, while its dof closes."""
    turn = quat_from_axis_angle(UP, np.array(yaw))
    thing = np.array([0.0, 0.0, 0.0, *turn])
    phase = np.repeat(np.arange(7, dtype=np.uint8), 4)
    heights = np.linspace(0.3, 0.1, len(phase) + 1)
    roots = np.array([compose(thing, np.array([side, 0.0, height, 1.0, 0, 0, 0])) for height in heights])
    states = np.hstack([roots, np.linspace(0, 1, len(phase) + 1)[:, None]])
    poses = np.tile(thing, (len(phase), 1))
    return Demonstration(0, Episode(0, 0, EpisodeOutcome.SUCCEEDED, phase, states[:-1], states[1:], poses))


def test_the_policy_moves_as_demonstrated_about_an_object_turned_otherwise() -> None:
    policy = train([demonstration(yaw, 0.05) for yaw in np.linspace(0, 5, 8)], steps=1000)
    shown = demonstration(2.6, 0.05)
    for frame in (2, 14, 22):
        found = policy.act(shown, frame, shown.episode.state[frame], shown.episode.object_pose[frame])
        # The noise in training leaves some millimetres.
        np.testing.assert_allclose(found, shown.episode.action[frame], atol=0.01)


def test_the_most_common_grasp_is_taken_on_the_face_of_the_object() -> None:
    shown = [demonstration(0.0, side) for side in (-0.3, 0.1, 0.11, 0.12)]
    assert most_common(shown, IDENTITY_POSE) is shown[1]
    assert (
        most_common(shown, np.array([0.0, 0, 0, *quat_from_axis_angle(np.array([1.0, 0, 0]), np.array(1.5))])) is None
    )
