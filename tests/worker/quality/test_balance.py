"""Non-negative least squares of many systems against SciPy's of one."""

from __future__ import annotations

import numpy as np
import pytest

from graspd.worker.control import squeeze
from graspd.worker.control.squeeze import nonnegative_weights

TARGET = np.zeros(23)
TARGET[6] = 10.0


def systems(count: int, columns: int, seed: int) -> np.ndarray:
    """(B, K, 23) like those of forces: a wrench of order one, a heavy row of the sum, light torques."""
    rng = np.random.default_rng(seed)
    made = rng.normal(size=(count, columns, 23))
    made[..., :6] += rng.normal(size=(count, 1, 6))
    made[..., 6] = 10.0
    made[..., 7:] *= 0.05
    return made


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("columns", [8, 32, 128])
def test_weights_are_scipy_s(columns: int, seed: int) -> None:
    made = systems(16, columns, seed)
    count = np.random.default_rng(seed).integers(1, columns + 1, 16)
    found = nonnegative_weights(made, TARGET, 0.1, count)
    wanted = [squeeze._plain(made[b], TARGET, 0.1, int(count[b])) for b in range(16)]
    # Both are exact but for rounding; the normal equations square the condition, some 1e5 here.
    np.testing.assert_allclose(found, wanted, atol=1e-9)


def test_the_kernel_needs_no_second_way(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(squeeze, "_plain", None)
    nonnegative_weights(systems(64, 96, 9), TARGET, 0.1, np.full(64, 96))


def test_what_only_makes_things_worse_has_no_weight() -> None:
    made = np.zeros((1, 2, 23))
    made[0, 0, 6], made[0, 1, 6] = 10.0, -10.0
    found = nonnegative_weights(made, TARGET, 0.1, np.array([2]))
    # min (10 x - 10)^2 + 0.01 x^2
    np.testing.assert_allclose(found, [[100 / 100.01, 0.0]], rtol=1e-12)


def test_columns_beyond_the_count_are_not_used() -> None:
    made = systems(3, 40, 1)
    made[:, 20:] = np.nan
    found = nonnegative_weights(made, TARGET, 0.1, np.full(3, 20))
    assert np.isfinite(found).all()
    assert not found[:, 20:].any()


def test_no_systems_have_no_weights() -> None:
    assert nonnegative_weights(np.zeros((0, 8, 23)), TARGET, 0.1, np.zeros(0, int)).shape == (0, 8)
