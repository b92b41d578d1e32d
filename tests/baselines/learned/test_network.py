"""A network's proposals are those of the architecture as its definition says, whatever else is asked for."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from graspd.baselines.learned import network as net
from graspd.service.model.errors import InputError
from graspd.service.store.network_file import ProposalNetwork
from tests.networks import random_network

Floats = np.ndarray[Any, np.dtype[np.float64]]


def cloud(count: int = 64, seed: int = 1) -> tuple[Floats, Floats]:
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return 0.05 * normals + [0.3, -0.2, 0.5], normals


def proposed(network: ProposalNetwork, count: int, **given: Any) -> net.Proposals:
    points, normals = cloud()
    rng = np.random.default_rng(7)
    return net.propose(network, points, normals, table_height=0.45, count=count, rng=rng, **given)


def assert_near(one: net.Proposals, other: net.Proposals, atol: float) -> None:
    for name, values in vars(one).items():
        np.testing.assert_allclose(values, getattr(other, name), atol=atol, err_msg=name)


def float64_rows(network: ProposalNetwork, noise: Floats, label: float) -> Floats:
    """The definition, point by point and row by row, in double precision."""
    w = {name: np.asarray(array, float) for name, array in network.weights.items()}
    points, normals = cloud()
    anchor = points.mean(axis=0)
    features = []
    for p, n in zip(points, normals, strict=True):
        h = np.array([*(p - anchor) / 0.1, *n, (p[2] - 0.45) / 0.1])
        for i in range(3):
            h = np.maximum(w[f"encoder.{i}.weight"] @ h + w[f"encoder.{i}.bias"], 0)
        features.append(h)
    feature = np.maximum(w["encoder.out.weight"] @ np.max(features, axis=0) + w["encoder.out.bias"], 0)
    condition = [*feature, (anchor[2] - 0.45) / 0.1, label]

    def silu(x: Floats) -> Floats:
        return x / (1 + np.exp(-x))

    rows = []
    for x in noise:
        for step in range(network.steps):
            t = step / network.steps
            angles = [2 * np.pi * 2**k * t for k in range(4)]
            h = np.array([*x, *np.sin(angles), *np.cos(angles), *condition])
            h = silu(w["flow.in.weight"] @ h + w["flow.in.bias"])
            for b in "01":
                inner = silu(w[f"flow.{b}.a.weight"] @ h + w[f"flow.{b}.a.bias"])
                h = h + w[f"flow.{b}.b.weight"] @ inner + w[f"flow.{b}.b.bias"]
            x = x + (w["flow.out.weight"] @ h + w["flow.out.bias"]) / network.steps
        rows.append(x * network.std + network.mean)
    return np.array(rows)


@pytest.mark.parametrize("label", [1.0, 0.0])
def test_proposals_are_those_of_definition_in_double_precision(label: float) -> None:
    network = random_network(["a", "b", "c"])
    noise = np.random.default_rng(7).standard_normal((3, network.numbers))
    expected = net.decode(float64_rows(network, noise, label), cloud()[0].mean(axis=0))
    found = proposed(network, 3, label=label)
    # Single precision: 16 steps of sums over 512 numbers of order 1, each rounded at 6e-8.
    assert_near(found, expected, 2e-5)


def test_a_proposal_does_not_depend_on_how_many_are_asked_for() -> None:
    network = random_network()
    one, many = proposed(network, 1), proposed(network, 70)
    for name, values in vars(one).items():
        assert np.array_equal(values[0], getattr(many, name)[0])
    assert len(np.unique(many.hand_pose[:, 0])) == 70


def test_order_of_points_and_where_table_stands_do_not_matter() -> None:
    network = random_network()
    points, normals = cloud()

    def seen(points: Floats, normals: Floats, table_height: float = 0.45) -> net.Proposals:
        rng = np.random.default_rng(0)
        return net.propose(network, points, normals, table_height=table_height, count=4, rng=rng)

    first = seen(points, normals)
    assert_near(seen(points[::-1], normals[::-1]), first, 1e-5)  # sums in single precision
    shift = np.array([0.2, 0.1, -0.3])
    moved = seen(points + shift, normals, 0.45 + shift[2])
    np.testing.assert_allclose(moved.hand_pose[:, :3], first.hand_pose[:, :3] + shift, atol=1e-5)
    np.testing.assert_allclose(moved.joints, first.joints, atol=1e-5)


def test_a_grasp_survives_its_row_and_a_bad_row_is_a_rotation() -> None:
    network = random_network(["a", "b", "c"])
    found = proposed(network, 5)
    np.testing.assert_allclose(np.linalg.norm(found.hand_pose[:, 3:], axis=1), 1, atol=1e-12)
    back = net.decode(net.encode(found, [0.1, 0.2, 0.3]), [0.1, 0.2, 0.3])
    assert_near(back, found, 1e-12)
    flat = np.zeros((3, network.numbers))
    flat[1, 3:9] = [0, 2, 0, 0, -1, 0]  # columns on one line
    flat[2, 3:9] = [3, 0, 0, 1, 2, 0]
    made = net.decode(flat, np.zeros(3))
    np.testing.assert_allclose(np.linalg.norm(made.hand_pose[:, 3:], axis=1), 1, atol=1e-12)
    np.testing.assert_allclose(made.hand_pose[2, 3:], [1, 0, 0, 0], atol=1e-12)
    np.testing.assert_allclose(made.approach, [[0, 0, -1]] * 3, atol=1e-12)


def test_clouds_that_are_none_and_wild_numbers_are_refused() -> None:
    network = random_network()
    points, normals = cloud()
    for p, n in ((points[:0], normals[:0]), (points, normals[:-1]), (points * np.nan, normals), (points.T, normals.T)):
        with pytest.raises(InputError, match="cloud"):
            net.propose(network, p, n, table_height=0, count=1, rng=np.random.default_rng(0))
    wild = random_network()
    wild.weights["flow.out.weight"][:] = 3e38
    with pytest.raises(InputError, match="not finite"):
        proposed(wild, 1)
