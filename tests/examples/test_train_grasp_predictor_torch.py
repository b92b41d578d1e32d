"""The network of the example in PyTorch; skipped where that is not installed."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed; `pip install torch` runs these tests")

from examples.train_grasp_predictor.evaluator import Attempts, Hands, learned, scores  # noqa: E402
from examples.train_grasp_predictor.network import Proposer  # noqa: E402
from examples.train_grasp_predictor.practice import TrainingRun  # noqa: E402
from examples.train_grasp_predictor.refinement import BEGUN, RefinedHands  # noqa: E402
from examples.train_grasp_predictor.samples import Scene, Sight, TrainedModel, sights, taught  # noqa: E402
from examples.train_grasp_predictor.training import TrainingData, train  # noqa: E402
from examples.train_grasp_predictor.without_network import SQUEEZE, across  # noqa: E402
from graspd.baselines.learned import network as net  # noqa: E402
from graspd.service.readers import open_shards  # noqa: E402
from graspd.service.store.network_file import ProposalNetwork  # noqa: E402
from graspd.worker.hands.model import HandModel  # noqa: E402
from graspd.worker.objects.prepare import object_from_path  # noqa: E402
from tests.service.readers import box_scenes  # noqa: E402


def test_what_torch_learns_is_what_the_planner_runs() -> None:
    torch.manual_seed(0)
    made = Proposer(12 + 3 * 4).eval()
    weights = {name: value.numpy() for name, value in made.state_dict().items()}
    mean, std = np.zeros(24, np.float32), np.ones(24, np.float32)
    file = ProposalNetwork("hand", "0" * 32, ("a", "b", "c", "d"), weights, mean, std, 32, 16)
    rng = np.random.default_rng(0)
    points, normals = rng.normal(0, 0.05, (32, 3)), rng.normal(size=(32, 3))
    inputs, anchor = net.cloud_inputs(points, normals, -0.1)
    noise = rng.standard_normal((5, 24)).astype(np.float32)
    condition = net.conditions(file, inputs[None], np.array([anchor[2] + 0.1]))
    found = net.flow(file, noise, np.repeat(condition, 5, axis=0))
    with torch.no_grad():
        seen = made.seen(torch.from_numpy(inputs)[None], torch.tensor([anchor[2] + 0.1], dtype=torch.float32))
        x = torch.from_numpy(noise)
        for step in range(16):
            time = torch.full((5,), step / 16)
            x = x + made.velocity(x, time, seen.expand(5, -1), torch.ones(5)) / 16
    # Sixteen steps of float32 in another order of sums.
    np.testing.assert_allclose(found, x.numpy(), atol=2e-5)


@pytest.fixture
def one_thread() -> Iterator[None]:
    """Threads of torch that wait for one another on a busy machine take minutes for seconds."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("one_thread")
def test_training_comes_nearer_to_the_grasps_that_it_is_shown(tmp_path: Path) -> None:
    box_scenes.write(tmp_path)
    shards = open_shards(tmp_path)
    lessons = TrainingData.of(sights(shards, noise="stereo"), [taught(shards, "box")])
    assert len(lessons) == box_scenes.VIEWS
    early, late = (train(lessons, steps=steps, seed=0) for steps in (10, 40))
    assert late.loss < 0.9 * early.loss


def ball() -> Sight:
    """A ball of 4 cm radius whose middle is 20 cm above the table."""
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(512, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    middle = np.array([0.0, 0.0, 0.2])
    return Sight(Scene("ball", "a" * 64, 0), middle + 0.04 * normals, normals, np.array([*middle, 1.0, 0, 0, 0]))


def hands_at(hand: HandModel, places: np.ndarray) -> net.Proposals:
    """Open hands that look down, all alike but for their places (N, 3)."""
    n = len(places)
    pose = np.concatenate([places, np.tile([0.0, 1.0, 0.0, 0.0], (n, 1))], axis=1)
    joints = np.tile(hand.expand(0.5 * (hand.lower + hand.upper)[None]), (n, 1))
    return net.Proposals(pose, np.tile([0.0, 0.0, -1.0], (n, 1)), joints, joints, joints)


@pytest.mark.usefixtures("one_thread")
def test_an_evaluator_tells_hands_at_the_object_from_others(hand: HandModel) -> None:
    sight, rng = ball(), np.random.default_rng(1)

    def around(count: int) -> tuple[net.Proposals, np.ndarray]:
        near = np.arange(count) % 2 == 0
        places = rng.normal(0, 0.01, (count, 3)) + np.array([0.0, 0.0, 0.35])
        places[~near, 0] += 0.15
        return hands_at(hand, places), near

    hands, near = around(64)
    evaluator = learned(hand, Attempts.of(hand, [sight], [hands], near), steps=30, seed=0)
    others, near = around(32)
    found = scores(evaluator, hand, sight, others)
    assert found[near].min() > found[~near].max()


class Wish(torch.nn.Module):
    """Thinks the more of a hand the nearer it is to a place."""

    def forward(self, points: torch.Tensor, normals: torch.Tensor, hands: Hands) -> torch.Tensor:
        return -100.0 * (hands.place - torch.tensor([0.0, 0.0, 0.6])).norm(dim=1)


def test_hands_move_to_where_the_evaluator_believes_in_them(hand: HandModel) -> None:
    def source(sight: Sight, count: int, rng: np.random.Generator) -> net.Proposals:
        assert count == BEGUN
        return hands_at(hand, rng.normal(0, 0.01, (count, 3)) + np.array([0.0, 0.03, 0.6]))

    def best(rounds: tuple[float, ...]) -> np.ndarray:
        refined = RefinedHands(hand, Wish(), source, rounds)(ball(), 2, np.random.default_rng(0))
        return np.linalg.norm(refined.hand_pose[:, :3] - [0.0, 0.0, 0.6], axis=1)

    chosen, moved_on = best(()), best((1.0, 0.7, 0.5, 0.4))
    assert chosen[0] < 0.03  # of hands around 3 cm the nearest
    assert moved_on[0] < 0.5 * chosen[0]
    assert moved_on[0] < moved_on[1]


@pytest.mark.slow
def test_practice_lifts_what_is_known_to_lift(hand: HandModel) -> None:
    block = object_from_path("block")
    pose = np.array([0.0, 0.0, -block.vertices[:, 2].min(), 1.0, 0, 0, 0])
    points = block.vertices[np.random.default_rng(0).choice(len(block.vertices), 512)] + pose[:3]
    sight = Sight(Scene("block", "a" * 64, 0), points, np.tile([0, 0, 1.0], (512, 1)), pose)
    held = across(hand, sight, 4, squeeze=SQUEEZE, rng=np.random.default_rng(0))
    rows = net.encode(held, np.zeros(3))
    given = TrainedModel([sight.scene] * 4, rows, np.ones(4), np.ones(4, bool), np.ones(4))
    far = dataclasses.replace(held, hand_pose=held.hand_pose + np.array([0.5, 0, 0, 0, 0, 0, 0]))
    practice = TrainingRun(hand, {"block": block}, [given], [sight], lambda *_: far)
    tries = practice.candidates(practice.beginning, 1, np.random.default_rng(0))
    assert not tries.lifted[:4].any()  # what the source proposed
    assert tries.lifted[4:].mean() >= 0.25  # grasps of the data, moved or not
