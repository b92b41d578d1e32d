"""Proposal networks for tests: of the right shapes, and of no skill."""

from collections.abc import Sequence

import numpy as np

from graspd.service.store.network_file import NETWORK_FILE, ProposalNetwork, row_size, to_bytes, weight_shapes

DIGEST = "0" * 32
#: A small job that sets out from a network, but for its options.
LEARNED = {"grasps": 3, "fidelity": "draft", "seed": 5, "rechecks": 0, "want": "candidates"}
LEARNED |= {"scene": "table", "scenes": 2, "method": "learned"}


def random_network(
    joint_names: Sequence[str] = ("a", "b"),
    *,
    hand: str = "some_hand",
    digest: str = DIGEST,
    points: int = 64,
    steps: int = 16,
    seed: int = 0,
) -> ProposalNetwork:
    """Weights as torch draws them for a fresh `Linear`: uniform within one over the root of the inputs."""
    rng = np.random.default_rng(seed)
    weights, bound = {}, 1.0
    for name, shape in weight_shapes(len(joint_names)).items():
        bound = shape[1] ** -0.5 if len(shape) == 2 else bound
        weights[name] = rng.uniform(-bound, bound, shape).astype(np.float32)
    count = row_size(len(joint_names))
    mean = rng.normal(0, 0.1, count).astype(np.float32)
    std = rng.uniform(0.05, 0.2, count).astype(np.float32)
    return ProposalNetwork(hand, digest, tuple(joint_names), weights, mean, std, points, steps, about="drawn by chance")


def network_files(network: ProposalNetwork) -> dict[str, bytes]:
    return {"asset.json": f'{{"file": "{NETWORK_FILE}"}}'.encode(), NETWORK_FILE: to_bytes(network)}
