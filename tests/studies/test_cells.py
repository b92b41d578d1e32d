"""Benchmarks of quality validate what a job would have made."""

from __future__ import annotations

import numpy as np

from benchmarks.cells import planned
from graspd.service.model.domain import JobOptions
from graspd.worker.generation import validated_grasps
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path


def test_a_study_plans_the_grasps_of_a_job() -> None:
    wish = JobOptions(want="candidates", fidelity="draft", seed=5, rechecks=0)
    hand, obj = hand_from_path("barrett"), object_from_path("block", face_error_m=wish.knobs.face_error_m)
    made = validated_grasps(hand, obj, wish, count=2).grasps
    found = planned(hand, obj, count=2, seed=5, fidelity="draft")
    assert np.array_equal(found.grasp.hand_pose, made.grasp.hand_pose)
    assert np.array_equal(found.squeeze.joint_positions, made.squeeze.joint_positions)
