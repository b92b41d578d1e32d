"""Intervals of shares."""

from __future__ import annotations

import numpy as np
import pytest

from graspd.worker.quality.intervals import wilson, wilson_of_mean


def test_the_bar_of_a_share_covers_the_truth_and_is_never_empty() -> None:
    """Of 4,000 samples of 20 at a share of 0.2 the interval covers it in 95 %; standard error 0.3 points."""
    counts = np.random.default_rng(2).binomial(20, 0.2, size=4000)
    bounds = np.array([wilson(int(k), 20) for k in counts])
    assert np.mean((bounds[:, 0] <= 0.2) & (bounds[:, 1] >= 0.2)) == pytest.approx(0.95, abs=0.025)
    assert wilson(0, 16)[1] > 0.1
    assert wilson(16, 16)[0] < 0.9


def test_a_mean_of_zeros_and_ones_is_a_share() -> None:
    for part, whole in ((0, 5), (3, 8), (8, 8), (41, 120)):
        assert wilson_of_mean(float(part), whole) == pytest.approx(wilson(part, whole), abs=1e-12)
    assert wilson(2, 8)[0] < wilson_of_mean(2.5, 8)[0] < wilson(3, 8)[0]
