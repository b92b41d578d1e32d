"""Policy of a flying hand in NumPy: a network from the state relative to the object to the next action.

Demonstrations of one object differ in their grasps, and their mean is no grasp. The policy is therefore told a grasp:
the pregrasp in the object's frame, the dofs of the squeeze, and the durations of the phases. In use this grasp is that
of a demonstration with many similar ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.transforms import (
    Floats,
    compose,
    invert,
    quat_conjugate,
    quat_from_axis_angle,
    quat_multiply,
    quat_rotate,
    quat_to_matrix,
)
from graspd.worker.episodes.episode import PHASES, Episode

#: Largest difference of similar grasps in position [m], rotation [rad] and dofs [rad or m, root mean square].
NEAR = (0.03, 0.5, 0.25)
#: Largest angle between the vertical of two poses of an object on the same resting face [rad].
SAME_FACE = 0.3
#: Noise on states in training, in transit and later [m], [rad]: the policy learns to return to the demonstrations.
NOISE = {True: (0.03, 0.15), False: (0.004, 0.03)}
WIDTH, STEPS, BATCH, RATE = 256, 10_000, 512, 1e-3
_UP = np.array([0.0, 0.0, 1.0])
_CLOSE = PHASES.index("close")


@dataclass(frozen=True)
class Demonstration:
    """A successful episode with one of the objects."""

    thing: int
    episode: Episode

    @cached_property
    def pregrasp(self) -> Floats:
        """Root pose in the object's frame, and dofs, at the end of `shape` (D,)."""
        at = int(np.flatnonzero(self.episode.phase < _CLOSE)[-1])
        state, pose = (np.asarray(part[at], float) for part in (self.episode.state, self.episode.object_pose))
        return np.concatenate([compose(invert(pose), state[:7]), state[7:]])

    @cached_property
    def goal(self) -> Floats:
        """Description of the grasp (G,): position, rotation and dofs of the pregrasp, dofs of the squeeze."""
        turn = quat_to_matrix(self.pregrasp[3:7])[:, :2].reshape(6)
        return np.concatenate([self.pregrasp[:3], turn, self.pregrasp[7:], self.episode.action[-1][7:]])

    @cached_property
    def clock(self) -> Floats:
        """Phase of each frame, and the elapsed share of the phase (T, P + 1)."""
        phase = self.episode.phase
        counts = np.bincount(phase, minlength=len(PHASES))
        shares = np.concatenate([np.arange(count) / max(1, count) for count in counts])
        return np.concatenate([np.eye(len(PHASES))[phase], shares[:, None]], axis=1)

    @cached_property
    def up(self) -> Floats:
        """The vertical (3,) in the object's frame."""
        return vertical(np.asarray(self.episode.object_pose[0], float))


def vertical(pose: Floats) -> Floats:
    """Return the vertical (3,) in the frame of an object at a pose (7,)."""
    return quat_rotate(quat_conjugate(pose[3:]), _UP)


def angle(a: Floats, b: Floats) -> Floats:
    """Return angles (...) between quaternions (..., 4) [rad]."""
    turn = quat_multiply(quat_conjugate(a), b)
    return np.asarray(2 * np.arctan2(np.linalg.norm(turn[..., 1:], axis=-1), np.abs(turn[..., 0])))


def most_common(shown: Sequence[Demonstration], object_pose: Floats) -> Demonstration | None:
    """Return the demonstration with most similar ones, all on the object's resting face; None if none is on it."""
    up = vertical(object_pose)
    shown = [one for one in shown if float(one.up @ up) > np.cos(SAME_FACE)]
    if not shown:
        return None
    all_ = np.array([one.pregrasp for one in shown])
    a, b = all_[:, None], all_[None]
    near = np.linalg.norm(a[..., :3] - b[..., :3], axis=-1) < NEAR[0]
    near &= angle(a[..., 3:7], b[..., 3:7]) < NEAR[1]
    near &= np.sqrt(((a[..., 7:] - b[..., 7:]) ** 2).mean(axis=-1)) < NEAR[2]
    return shown[int(near.sum(axis=1).argmax())]


class Network:
    """Perceptron with two hidden layers; trained by Adam (Kingma and Ba, 2015) on squared errors."""

    def __init__(self, given: int, wanted: int, rng: np.random.Generator) -> None:
        sizes = (given, WIDTH, WIDTH, wanted)
        self.weights = [rng.normal(0, np.sqrt(2 / a), (a, b)) for a, b in pairwise(sizes)]
        self.biases = [np.zeros(size) for size in sizes[1:]]
        self._moments = [(np.zeros_like(p), np.zeros_like(p)) for p in (*self.weights, *self.biases)]
        self._steps = 0

    def _layers(self, x: Floats) -> list[Floats]:
        found = [x]
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            found.append(np.maximum(found[-1] @ weight + bias, 0.0))
        found.append(found[-1] @ self.weights[-1] + self.biases[-1])
        return found

    def __call__(self, x: Floats) -> Floats:
        return self._layers(x)[-1]

    def learn(self, x: Floats, y: Floats, rate: float) -> float:
        """Take one step on a batch; return its mean squared error before the step."""
        layers = self._layers(x)
        error = layers[-1] - y
        slope, of_weights, of_biases = 2 * error / error.size, list[Floats](), list[Floats]()
        for number in reversed(range(len(self.weights))):
            of_weights.insert(0, layers[number].T @ slope)
            of_biases.insert(0, slope.sum(axis=0))
            slope = (slope @ self.weights[number].T) * (layers[number] > 0)
        self._steps += 1
        for value, slope, (mean, square) in zip(
            (*self.weights, *self.biases), (*of_weights, *of_biases), self._moments, strict=True
        ):
            mean += 0.1 * (slope - mean)
            square += 0.001 * (slope**2 - square)
            first, second = 1 - 0.9**self._steps, 1 - 0.999**self._steps
            value -= rate * (mean / first) / (np.sqrt(square / second) + 1e-8)
        return float((error**2).mean())


@dataclass
class Policy:
    """A trained network."""

    network: Network
    scale: tuple[Floats, Floats, Floats, Floats] = field(repr=False)  # means and deviations of inputs and outputs

    def act(self, told: Demonstration, frame: int, state: Floats, object_pose: Floats) -> Floats:
        """Return the action (D,) for one state (D,) and object pose (7,)."""
        given = observation(state[None], object_pose[None], told.clock[frame][None], told.goal[None])
        centre, width, middle, wide = self.scale
        wanted = self.network((given - centre) / width)[0] * wide + middle
        turn = np.concatenate([[1.0], wanted[3:6]])
        step = np.concatenate([wanted[:3], turn / np.linalg.norm(turn)])
        return np.concatenate([compose(state[:7], step), wanted[6:]])


def observation(state: Floats, object_pose: Floats, clock: Floats, goal: Floats) -> Floats:
    """Return inputs (N, K): the root in the object's frame, the vertical, the object's height, dofs, clock, grasp."""
    root = compose(invert(object_pose), state[:, :7])
    turn = quat_to_matrix(root[:, 3:])[:, :, :2].reshape(len(root), 6)
    up = quat_rotate(quat_conjugate(state[:, 3:7]), np.broadcast_to(_UP, (len(state), 3)))
    return np.concatenate([root[:, :3], turn, up, object_pose[:, 2:3], state[:, 7:], clock, goal], axis=1)


def step_to(state: Floats, action: Floats) -> Floats:
    """Return outputs (N, 6 + H): the action's root in the state's, its rotation as q_xyz / q_w, and dofs."""
    step = compose(invert(state[:, :7]), action[:, :7])
    return np.concatenate([step[:, :3], step[:, 4:] / step[:, 3:4], action[:, 7:]], axis=1)


def train(shown: Sequence[Demonstration], *, seed: int = 0, steps: int = STEPS) -> Policy:
    """Return the policy cloned from demonstrations."""
    rng = np.random.default_rng(seed)
    state, action, thing = (
        np.concatenate([np.asarray(getattr(one.episode, name), float) for one in shown])
        for name in ("state", "action", "object_pose")
    )
    clock = np.concatenate([one.clock for one in shown])
    transit = np.concatenate([one.episode.phase == 0 for one in shown])
    goal = np.repeat([one.goal for one in shown], [len(one.episode.phase) for one in shown], axis=0)

    def sample(rows: NDArray[np.intp]) -> tuple[Floats, Floats]:
        seen = np.array(state[rows])
        seen[:, :7] = compose(seen[:, :7], _noise(transit[rows], rng))
        return observation(seen, thing[rows], clock[rows], goal[rows]), step_to(seen, action[rows])

    given, wanted = sample(np.arange(len(state)))
    scale = (given.mean(0), given.std(0) + 1e-3, wanted.mean(0), wanted.std(0) + 1e-4)
    network = Network(given.shape[1], wanted.shape[1], rng)
    for step in range(steps):
        x, y = sample(rng.integers(len(state), size=BATCH))
        rate = RATE * 0.5 * (1 + np.cos(np.pi * step / steps))
        network.learn((x - scale[0]) / scale[1], (y - scale[2]) / scale[3], rate)
    return Policy(network, scale)


def _noise(transit: NDArray[np.bool_], rng: np.random.Generator) -> Floats:
    far, turn = (np.where(transit, NOISE[True][k], NOISE[False][k]) for k in (0, 1))
    axis = rng.normal(size=(len(transit), 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    moved = rng.normal(size=(len(transit), 3)) * far[:, None]
    return np.concatenate([moved, quat_from_axis_angle(axis, turn * rng.normal(size=len(turn)))], axis=1)
