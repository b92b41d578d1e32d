"""Features of grasps: principal components and nearest neighbours against independent computations."""

import numpy as np
import pytest

from graspd.api.catalog.grasp_map import nearest, principal_components


@pytest.mark.parametrize("count", [1, 2, 40])
def test_a_map_shows_the_largest_variances(count: int) -> None:
    values = np.random.default_rng(count).normal(size=(count, 6)) * [5, 1, 3, 0.5, 0.2, 0.1]
    values -= values.mean(axis=0)
    found = principal_components(values)
    largest = np.linalg.eigvalsh(values.T @ values)[::-1][:2]
    np.testing.assert_allclose((found**2).sum(axis=0), np.maximum(largest, 0), atol=1e-9)
    assert abs(found[:, 0] @ found[:, 1]) < 1e-9


def test_the_nearest_are_those_of_least_distance_without_itself() -> None:
    values = np.array([[0.0, 0], [3, 0], [0, 1], [0, -2], [0, 0]])
    assert nearest(values, 0, 3).tolist() == [4, 2, 3]
