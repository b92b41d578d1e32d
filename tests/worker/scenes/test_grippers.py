"""A parallel gripper in a scene: its pads come down beside an object that fits, and lift it."""

from __future__ import annotations

import trimesh

from graspd.service.model.domain import JobOptions
from graspd.service.model.scene_spec import SceneSpec
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.generation import validated_grasps
from graspd.worker.scenes.kinds import rest_poses, supports_of
from graspd.worker.simulation.environment import Scenes
from tests.worker.hands.grippers import gripper
from tests.worker.models import object_from_mesh


def test_a_gripper_lifts_a_box_from_a_table() -> None:
    hand, box = gripper(), object_from_mesh(trimesh.creation.box((0.03, 0.04, 0.06)))
    spec = SceneSpec(kind="table")
    scenes = Scenes(supports_of(spec), rest_poses(spec, box, count=2, seed=1)["scene/object_pose"])
    wanted = JobOptions(scene="table", fidelity="draft", want="candidates", grasps=4, seed=2)
    found = validated_grasps(hand, box, wanted, count=4, scenes=scenes, run=ExecutionContext(threads=1))
    # A box between flat pads is the plainest of tasks: hardly a grasp may miss it.
    assert found.shares["lift_share"] >= 0.75
