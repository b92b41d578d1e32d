"""Means and distributions counted by the database, held against NumPy."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import insert

from service.index.filters import GraspFilter
from service.index.index import Index
from service.index.tables import METRICS, grasps

COUNT = 500
BINS = 12


@pytest.fixture
def values() -> np.ndarray:
    return np.random.default_rng(7).gamma(2.0, 0.3, COUNT)


@pytest.fixture
def index(tmp_path: Path, values: np.ndarray) -> Iterator[Index]:
    opened = Index(f"sqlite:///{tmp_path / 'index.sqlite'}")
    plain = dict.fromkeys(METRICS) | {
        "shard_id": "a" * 32,
        "hand": "h",
        "object": "o",
        "created": "2026-01-01T00:00:00Z",
    }
    rows = [plain | {"row": row, "epsilon": value, "valid": row % 2 == 0} for row, value in enumerate(values)]
    with opened.writing() as connection:
        connection.execute(insert(grasps), rows)
    yield opened
    opened.close()


def test_a_summary_is_the_mean_and_range_of_what_passes_the_filter(index: Index, values: np.ndarray) -> None:
    found = index.summaries(GraspFilter(valid=True), ("epsilon",))["epsilon"]
    passed = values[::2]
    assert found.count == len(passed)
    assert (found.mean, found.low, found.high) == pytest.approx((passed.mean(), passed.min(), passed.max()))


def test_a_metric_that_no_grasp_has_is_left_out(index: Index) -> None:
    assert set(index.summaries(GraspFilter(), ("epsilon", "contact_area_cm2"))) == {"epsilon"}


def test_no_grasp_has_no_summary(index: Index) -> None:
    assert index.summaries(GraspFilter(hand="other"), ("epsilon",)) == {}


def test_a_histogram_counts_as_numpy_does(index: Index, values: np.ndarray) -> None:
    low, high = float(values.min()), float(values.max())
    expected, _ = np.histogram(values, BINS, (low, high))
    assert index.histogram(GraspFilter(), "epsilon", low, high, BINS) == expected.tolist()


def test_values_that_are_all_alike_fall_into_one_bin(index: Index, values: np.ndarray) -> None:
    one = float(values[3])
    assert index.histogram(GraspFilter(), "epsilon", one, one, BINS) == [1] + [0] * (BINS - 1)
