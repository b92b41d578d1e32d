"""The language that chooses grasps by their numbers."""

from typing import Any

import numpy as np
import pytest

from graspd.service.model.errors import InputError
from graspd.service.model.where import LONGEST
from graspd.service.readers.where import compile_expression

COLUMNS: dict[str, Any] = {
    "quality/thresholds_m": np.array([0.002, 0.005]),
    "quality/epsilon": np.array([[0.9, 0.1], [0.0, 0.4], [0.9, np.nan], [0.0, 0.3]]),
    "quality/penetration_depth_mm": np.array([0.5, 1.5, 0.5, 2.5]),
    "quality/valid": np.array([1, 1, 1, 0], np.uint8),
    "quality/success": np.array([1, 1, 1, 0], np.int8),
    "quality/lift_outcome": np.array([1, 5, 1, 1], np.uint8),
    "quality/grasp_type": np.array([1, 2, 3, 0], np.int32),
}
SAID = {"hand": "allegro", "object": "006_mustard_bottle"}


@pytest.mark.parametrize(
    ("text", "rows"),
    [
        ("epsilon > 0.3", [1]),  # the value at 5 mm, not the one at 2 mm
        ("epsilon>=.3", [1, 3]),
        ("not epsilon > 0.3", [0, 2, 3]),
        ("epsilon = 3e-1 or epsilon != 0.1 and valid", [1, 3]),
        ("(epsilon = 0.3 or epsilon != 0.1) and valid", [1]),
        ("valid and lift", [0, 2]),
        ("lift and not held", [3]),
        ("not validated", []),
        ("type = power or type = 'lateral'", [0, 2]),
        ("hand = allegro and object = 006_mustard_bottle and penetration_depth_mm < 1", [0, 2]),
        ("hand != allegro", []),
        ("clearance_m > -1", []),  # a shard that lacks a metric fails every comparison with it
        ("robust >= 0.75 or robust_share < 0.75", []),
    ],
)
def test_an_expression_chooses_what_it_says(text: str, rows: list[int]) -> None:
    assert np.flatnonzero(compile_expression(text)(COLUMNS, SAID)).tolist() == rows


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "ends where a name"),
        ("epsilon", "needs a comparison"),
        ("epsilon >", "ends where a value"),
        ("epsilon > big", "compared with a number"),
        ("epsilon > 1 valid", "follows a complete expression"),
        ("valid > 0", "is a flag"),
        ("(valid", "not closed"),
        ("and valid", "where a name is expected"),
        ("beauty > 1", "there is no 'beauty'; the names are epsilon"),
        ("type = pinch", "no type 'pinch'"),
        ("hand < allegro", "a word by = or !="),
        ("hand = 5", "a word, not with '5'"),
        ("epsilon > 1; import os", "cannot be read"),
        ("__import__('os').system('true')", "cannot be read"),
        ("(" * 200 + "valid" + ")" * 200, "nested"),
        ("not " * 200 + "valid", "nested"),
        ("valid and " * LONGEST, "characters long"),
    ],
)
def test_what_is_no_expression_is_refused_in_a_line(text: str, words: str) -> None:
    with pytest.raises(InputError, match=words) as refused:
        compile_expression(text)
    assert "\n" not in str(refused.value)
