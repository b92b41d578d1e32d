"""The self-test of a hand: objects that suit it, and a line that says whether it is ready."""

from __future__ import annotations

import numpy as np
import pytest

from tests.worker.hands.grippers import OPENING, gripper
from tests.worker.hands.urdfs import joint, link, robot
from worker.hands.jaws import jaws_of
from worker.hands.load import load_hand
from worker.stages.hand_self_test import OF_OPENING, OF_REACH, SelfTest, fitting_width, plain_objects, self_test

_PALM = '<collision><geometry><box size="0.09 0.09 0.02"/></geometry></collision>'
_FINGER = '<collision><origin xyz="0 0 0.05"/><geometry><box size="0.012 0.012 0.1"/></geometry></collision>'


def test_objects_are_as_wide_as_suits_the_opening() -> None:
    width = fitting_width(gripper())
    assert width == pytest.approx(OF_OPENING * OPENING)
    for obj in plain_objects(width).values():
        # A sphere of triangles lies inside the true one by less than a hundredth.
        assert np.ptp(obj.vertices, axis=0).min() == pytest.approx(width, rel=0.01)


def test_a_hand_that_drops_one_kind_of_object_is_suspicious() -> None:
    assert SelfTest(0.91, 64, 0.04, {"box": 0.9, "sphere": 0.92}).line == "ready: 91 % hold"
    assert "suspicious: 50 % hold, 10 % of a box" in SelfTest(0.5, 64, 0.04, {"box": 0.1, "sphere": 0.9}).line


def test_a_finger_of_one_joint_reaches_to_its_pad_and_not_only_to_its_base() -> None:
    fingers = [
        part
        for number, (x, y) in enumerate(((0.03, 0.0), (-0.015, 0.026), (-0.015, -0.026)))
        for part in (
            link(f"finger{number}", _FINGER),
            joint(f"bend{number}", "palm", f"finger{number}", origin=f"{x} {y} 0.01", axis=f"{y} {-x} 0"),
        )
    ]
    urdf = robot(link("palm", _PALM), *fingers)
    hand = load_hand({"r.urdf": urdf}, name="r", digest="0" * 32, options={"approach": [0, 0, 1]})
    assert jaws_of(hand) is None
    # Its joints lie 30 mm from the palm's middle, its pads beyond half of the 100 mm of a finger.
    assert OF_REACH * 0.05 < fitting_width(hand) < OF_REACH * 0.11


@pytest.mark.slow
def test_a_parallel_gripper_holds_what_fits() -> None:
    found = self_test(gripper(), grasps=12)
    assert found.n == 12
    assert found.gsr >= 0.7
