"""Distinct values of arrays of integers, as NumPy's own function has them."""

from __future__ import annotations

import subprocess
import sys

import numpy as np

from graspd.service.model.integers import distinct_values


def test_values_are_ascending_and_each_there_once() -> None:
    rng = np.random.default_rng(0)
    for values in (rng.integers(-5, 5, (7, 3)), np.zeros(0, int), np.array([2, 2, -1], np.int32)):
        assert distinct_values(values) == np.unique(values).tolist()


def test_masked_arrays_are_not_loaded_for_it() -> None:
    code = (
        "import sys, numpy as np; from graspd.service.model.integers import distinct_values\n"
        "distinct_values(np.arange(3))\n"
        "sys.exit('numpy.ma' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
