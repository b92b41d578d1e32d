"""The network of the example in PyTorch; skipped where that is not installed."""

from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed; `pip install torch` runs these tests")

from examples.train_grasp_predictor.network import Proposer  # noqa: E402
from examples.train_grasp_predictor.samples import sights, taught  # noqa: E402
from examples.train_grasp_predictor.training import TrainingData, train  # noqa: E402
from graspd.baselines.learned import network as net  # noqa: E402
from graspd.service.readers import open_shards  # noqa: E402
from graspd.service.store.network_file import ProposalNetwork  # noqa: E402
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
    condition = net.flow_conditions(file, inputs[None], np.array([anchor[2] + 0.1]))
    found = net.integrate_flow(file, noise, np.repeat(condition, 5, axis=0))
    with torch.no_grad():
        seen = made.seen(torch.from_numpy(inputs)[None], torch.tensor([anchor[2] + 0.1], dtype=torch.float32))
        x = torch.from_numpy(noise)
        for step in range(16):
            time = torch.full((5,), step / 16)
            x = x + made.velocity(x, time, seen.expand(5, -1), torch.ones(5)) / 16
    # Sixteen steps of float32 in another order of sums.
    np.testing.assert_allclose(found, x.numpy(), atol=2e-5)


def test_training_comes_nearer_to_the_grasps_that_it_is_shown(tmp_path: Path) -> None:
    torch.set_num_threads(1)  # those that wait for one another on a busy machine take minutes for seconds
    box_scenes.write(tmp_path)
    shards = open_shards(tmp_path)
    lessons = TrainingData.of(sights(shards, noise="stereo"), [taught(shards, "box")])
    assert len(lessons) == box_scenes.VIEWS
    early, late = (train(lessons, steps=steps, seed=0) for steps in (10, 40))
    assert late.loss < 0.9 * early.loss
