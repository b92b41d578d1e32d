"""Comparison of batches and sets of grasps, for tests of what must not change a bit of them."""

from __future__ import annotations

import numpy as np

from graspd.worker.generation import ValidatedBatch
from graspd.worker.grasps import GraspSet


def assert_same_grasps(one: GraspSet | Exception, other: GraspSet) -> None:
    assert isinstance(one, GraspSet)
    columns, others = one.to_columns(), other.to_columns()
    assert columns.keys() == others.keys()
    for name, values in others.items():
        np.testing.assert_array_equal(columns[name], values, err_msg=name)
    np.testing.assert_array_equal(one.stability_loss, other.stability_loss)


def assert_same_batch(one: ValidatedBatch, other: ValidatedBatch) -> None:
    assert_same_grasps(one.grasps, other.grasps)
    assert (one.candidates, one.rejected, one.verdict_key) == (other.candidates, other.rejected, other.verdict_key)
    assert one.columns.keys() == other.columns.keys()
    for name, values in other.columns.items():
        np.testing.assert_array_equal(one.columns[name], values, err_msg=name)
