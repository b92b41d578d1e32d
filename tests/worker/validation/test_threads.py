"""What is asked of which grasp."""

from __future__ import annotations

import numpy as np
import pytest

from graspd.service.model.errors import TaskCancelled
from graspd.worker.execution_context import DEFAULT_CONTEXT, ExecutionContext
from graspd.worker.validation.compiled import measured


def test_only_grasps_that_are_held_are_tested_and_each_by_its_row() -> None:
    held = np.array([False, True, False, True])
    found = measured(4, held, lambda: 10.0, lambda test, row: test + row, run=DEFAULT_CONTEXT, name="test")
    np.testing.assert_array_equal(found, [np.nan, 11.0, np.nan, 13.0])
    assert measured(2, None, lambda: 10.0, lambda test, row: test + row, run=DEFAULT_CONTEXT, name="test").tolist() == [
        10,
        11,
    ]


def test_where_none_is_held_no_test_is_made() -> None:
    assert np.isnan(
        measured(2, np.zeros(2, bool), lambda: 1 / 0, lambda *_: 0.0, run=DEFAULT_CONTEXT, name="test")
    ).all()


def test_between_two_grasps_it_may_be_stopped() -> None:
    run = ExecutionContext(threads=1, cancelled=lambda: True)
    with pytest.raises(TaskCancelled):
        measured(2, None, lambda: None, lambda *_: 0.0, run=run, name="test")
