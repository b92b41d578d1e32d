"""Figures of synthesize 18 hold for 19: none of their objects is too small or too wide for the pads of their hands.
Those of 19 hold for 20: none of their hands is a gripper of more than two digits."""

from __future__ import annotations

from pathlib import Path

import pytest

from worker.hands.jaws import MAX_DOFS
from worker.hands.load import hand_from_path
from worker.objects.prepare import object_from_path
from worker.planners.fast_graspd.across import crossings_of
from worker.planners.fast_graspd.reaching import size_to_pads

HANDS = ("allegro/allegro_hand_right.urdf", "barrett_bh280/bh280.urdf", "shadow/shadow_hand_right.urdf")


@pytest.mark.parametrize("file", [*HANDS, "allegro", "barrett", "shadow"])
def test_pads_of_the_hands_hold_the_objects_of_the_docs(file: str, shared_data: Path) -> None:
    hand = hand_from_path(shared_data / "hands" / file if "/" in file else file)
    meshes = sorted((shared_data / "objects").glob("*/clean.stl"))
    assert len(meshes) >= 14
    sizes = {mesh.parent.name: size_to_pads(hand, crossings_of(object_from_path(mesh)).width) for mesh in meshes}
    assert not any(sizes.values()), sizes


@pytest.mark.parametrize("file", [*HANDS, "allegro", "barrett", "shadow"])
def test_no_hand_of_the_docs_is_a_gripper(file: str, shared_data: Path) -> None:
    hand = hand_from_path(shared_data / "hands" / file if "/" in file else file)
    assert hand.dofs > MAX_DOFS


@pytest.mark.parametrize("name", ["allegro", "barrett", "shadow"])
def test_pads_of_the_hands_hold_the_built_in_objects(name: str) -> None:
    hand = hand_from_path(name)
    sizes = {obj: size_to_pads(hand, crossings_of(object_from_path(obj)).width) for obj in ("mug", "bottle", "block")}
    assert not any(sizes.values()), sizes
