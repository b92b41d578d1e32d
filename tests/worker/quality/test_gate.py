"""The geometric gate and its three bounds."""

from __future__ import annotations

import numpy as np
import pytest

from graspd.worker.quality.gate import MAX_PENETRATION_MM, MAX_SELF_PENETRATION_MM, MIN_CONTACT_LINKS, passes

GOOD = {"penetration_depth_mm": 0.5, "self_penetration_depth_mm": 0.0, "contact_links": 3.0}


def gate(**changes: float) -> bool:
    return bool(passes({f"quality/{name}": np.array([value]) for name, value in (GOOD | changes).items()})[0])


def test_a_good_grasp_passes() -> None:
    assert gate()


@pytest.mark.parametrize(
    ("name", "bound", "worse"),
    [
        ("penetration_depth_mm", MAX_PENETRATION_MM, 1e-9),
        ("self_penetration_depth_mm", MAX_SELF_PENETRATION_MM, 1e-9),
        ("contact_links", MIN_CONTACT_LINKS, -1),
    ],
)
def test_each_bound_is_inclusive_and_decides_alone(name: str, bound: float, worse: float) -> None:
    assert gate(**{name: bound})
    assert not gate(**{name: bound + worse})


@pytest.mark.parametrize("name", ["penetration_depth_mm", "self_penetration_depth_mm"])
def test_what_could_not_be_measured_does_not_pass(name: str) -> None:
    assert not gate(**{name: float("nan")})
