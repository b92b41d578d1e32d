"""Figures of synthesize 18 hold for 19: none of their objects is too small or too wide for the pads of their hands.
Those of 19 hold for 20: none of their hands is a gripper of more than two digits. Those of 20 hold for 21 in scenes:
there, points are not pulled, and hands set out from where they did. So do those of 21 for 22: there, objects have the
samples they had, and the projection is the same. So do those of 22 for 23: there, no grasp sets out again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from graspd.service.model.fidelity import FIDELITIES
from graspd.worker.hands.jaws import MAX_DOFS
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.planners.fast_graspd import scene_starts
from graspd.worker.planners.fast_graspd.antipodal_starts import crossings_of, size_to_pads
from graspd.worker.planners.fast_graspd.pairs import pair_of
from graspd.worker.simulation.environment import Environment, Obstacle
from graspd.worker.simulation.obstacles import DeviceObstacles

HANDS = ("allegro/allegro_hand_right.urdf", "barrett_bh280/bh280.urdf", "shadow/shadow_hand_right.urdf")
BUILT_IN = ("allegro", "barrett", "shadow")


@pytest.mark.slow
@pytest.mark.parametrize("file", [*HANDS, *BUILT_IN])
def test_pads_of_the_hands_hold_the_objects_of_the_docs(file: str, shared_data: Path) -> None:
    hand = hand_from_path(shared_data / "hands" / file if "/" in file else file)
    meshes = sorted((shared_data / "objects").glob("*/clean.stl"))
    assert len(meshes) >= 14
    sizes = {mesh.parent.name: size_to_pads(hand, crossings_of(object_from_path(mesh)).width) for mesh in meshes}
    assert not any(sizes.values()), sizes


@pytest.mark.parametrize("file", [*HANDS, *BUILT_IN])
def test_no_hand_of_the_docs_is_a_gripper_and_pads_hold_the_built_in_objects(file: str, shared_data: Path) -> None:
    hand = hand_from_path(shared_data / "hands" / file if "/" in file else file)
    assert hand.dofs > MAX_DOFS
    sizes = {obj: size_to_pads(hand, crossings_of(object_from_path(obj)).width) for obj in ("mug", "bottle", "block")}
    assert not any(sizes.values()), sizes


def test_in_scenes_no_point_is_pulled_and_palms_start_as_before() -> None:
    hand, obj = hand_from_path("barrett"), object_from_path("block")
    pair = pair_of(hand, obj, FIDELITIES["standard"], "cpu")
    table = Environment((Obstacle.half_space([0, 0, 1], -0.05),), np.array([0.0, 0.0, 1.0]))
    obstacles = DeviceObstacles.create(hand, [table], obj.centre_of_mass, "cpu")
    for side in (pair.coarse, pair.fine):
        assert pair.model(side).options.pull > 0
        assert pair.model(side, obstacles).options == replace(pair.model(side).options, pull=0.0)
    assert scene_starts.GAP == (0.004, 0.02)
