"""What a base shard says of its grasps: valid needs a validator."""

from __future__ import annotations

import numpy as np
import pytest

from graspd.service.store import validity

FLAGS = np.array([1, 1, 0], np.uint8)


def test_where_nobody_validated_nothing_is_valid() -> None:
    columns = {"quality/valid": np.zeros(3, np.uint8), "quality/feasible": FLAGS}
    assert not validity.valid(columns).any()
    assert validity.chosen(columns, unvalidated=True).tolist() == [True, True, False]


def test_a_shard_of_graspd_0_1_that_nobody_validated_is_not_taken_for_validated() -> None:
    assert not validity.valid({"quality/valid": FLAGS}).any()
    assert validity.chosen({"quality/valid": FLAGS}, unvalidated=True).tolist() == [True, True, False]


@pytest.mark.parametrize("verdict, valid, unvalidated", [(1, [True, True, False], []), (-1, [], [True, True, False])])
def test_a_verdict_counts_only_where_there_is_one(verdict: int, valid: list[bool], unvalidated: list[bool]) -> None:
    columns = {"quality/valid": FLAGS, "quality/feasible": FLAGS, "quality/success": np.full(3, verdict, np.int8)}
    assert validity.valid(columns).tolist() == (valid or [False] * 3)
    assert validity.chosen(columns, unvalidated=True).tolist() == (unvalidated or [False] * 3)


def test_a_grasp_that_was_validated_and_dropped_is_neither() -> None:
    columns = {
        "quality/valid": np.zeros(1, np.uint8),
        "quality/feasible": np.ones(1, np.uint8),
        "quality/success": np.zeros(1, np.int8),
    }
    assert not validity.chosen(columns).any()
    assert not validity.chosen(columns, unvalidated=True).any()
