"""Means and distributions counted by the database, held against NumPy."""

import hashlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import insert

from graspd.service.index.index import Index
from graspd.service.index.queries.grasps import GraspFilter
from graspd.service.index.tables import METRICS, grasps, shards
from tests.indexes import empty_index

COUNT = 500
BINS = 12
CREATED = "2026-01-01T00:00:00Z"


@pytest.fixture
def values() -> np.ndarray:
    return np.random.default_rng(7).gamma(2.0, 0.3, COUNT)


@pytest.fixture
def index(tmp_path: Path, values: np.ndarray) -> Iterator[Index]:
    opened = empty_index(f"sqlite:///{tmp_path / 'index.sqlite'}")
    plain = dict.fromkeys(METRICS) | {"shard_id": "a" * 32, "hand": "h", "object": "o", "created": CREATED}
    rows = [plain | {"row": row, "epsilon": value, "valid": row % 2 == 0} for row, value in enumerate(values)]
    with opened.database.write_transaction() as connection:
        connection.execute(insert(grasps), rows)
    yield opened
    opened.close()


def test_a_summary_is_of_what_passes_the_filter(index: Index, values: np.ndarray) -> None:
    summaries = index.statistics.summaries(GraspFilter(valid=True), ("epsilon", "contact_area_cm2"))
    found, passed = summaries.pop("epsilon"), values[::2]
    assert found.count == len(passed) and summaries == {}
    assert (found.mean, found.low, found.high) == pytest.approx((passed.mean(), passed.min(), passed.max()))
    assert index.statistics.summaries(GraspFilter(hand="other"), ("epsilon",)) == {}


def test_a_histogram_counts_as_numpy_does(index: Index, values: np.ndarray) -> None:
    low, high, one = float(values.min()), float(values.max()), float(values[3])
    expected, _ = np.histogram(values, BINS, (low, high))
    assert index.statistics.histogram(GraspFilter(), "epsilon", low, high, BINS) == expected.tolist()
    alike = index.statistics.histogram(GraspFilter(), "epsilon", one, one, BINS)
    assert alike == [1] + [0] * (BINS - 1)


def test_distributions_of_few_grasps_are_exact(index: Index, values: np.ndarray) -> None:
    found = index.statistics.compare_distributions(
        [GraspFilter(valid=True)], ("epsilon", "contact_area_cm2"), bins=BINS
    )
    passed = values[::2]
    ((one,),) = found.values()
    assert one is not None and one.counts == np.histogram(passed, BINS)[0].tolist()
    assert one.mean == pytest.approx(passed.mean())


def test_distributions_of_many_grasps_come_from_a_fair_sample(index: Index) -> None:
    with index.database.write_transaction() as connection:
        for number in range(400):
            shard = hashlib.sha256(str(number).encode()).hexdigest()[:32]
            made = {"shard_id": shard, "hand": "a", "object": "b", "created": CREATED, "valid": True}
            rows = [made | {"row": row, "epsilon": number / 400} for row in range(8)]
            connection.execute(insert(grasps), rows)
            connection.execute(insert(shards), _shard(shard, hand="a", object="b", count=8))
    (found,) = index.statistics.compare_distributions([GraspFilter(hand="a", object="b")], ("epsilon",), at_most=800)[
        "epsilon"
    ]
    # 100 shards are expected; the number drawn has a standard deviation of 9, their mean one of 0.03.
    assert found is not None and 60 * 8 < found.count < 140 * 8
    assert found.mean == pytest.approx(0.5, abs=0.12)


def _shard(shard: str, **fields: object) -> dict[str, object]:
    texts = dict.fromkeys(("key", "sha256", "hand_digest", "object_digest", "device", "worker", "created"), "x")
    numbers = dict.fromkeys(("size_bytes", "valid", "batch", "seed", "seconds"), 0)
    return {"id": shard, "kind": "base", "stage": "synthesize", "inputs": [], "manifest": {}} | texts | numbers | fields
