"""The self-test of a hand: objects that suit it, and a line that says whether it is ready."""

from __future__ import annotations

import numpy as np
import pytest

from tests.worker.hands.grippers import OPENING, gripper
from worker.stages.hand_self_test import OF_OPENING, SelfTest, fitting_width, plain_objects, self_test


def test_objects_are_as_wide_as_suits_the_opening() -> None:
    width = fitting_width(gripper())
    assert width == pytest.approx(OF_OPENING * OPENING)
    for obj in plain_objects(width).values():
        # A sphere of triangles lies inside the true one by less than a hundredth.
        assert np.ptp(obj.vertices, axis=0).min() == pytest.approx(width, rel=0.01)


def test_a_hand_that_drops_one_kind_of_object_is_suspicious() -> None:
    assert SelfTest(0.91, 64, 0.04, {"box": 0.9, "sphere": 0.92}).line == "ready: 91 % hold"
    assert "suspicious: 50 % hold, 10 % of a box" in SelfTest(0.5, 64, 0.04, {"box": 0.1, "sphere": 0.9}).line


@pytest.mark.slow
def test_a_parallel_gripper_holds_what_fits() -> None:
    found = self_test(gripper(), grasps=12)
    assert found.n == 12
    assert found.gsr >= 0.7
