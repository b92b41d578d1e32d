"""No two grasps of a batch are alike, and memory does not grow with batches."""

from __future__ import annotations

import resource

import numpy as np
import pytest

from graspd.service.model.fidelity import FIDELITIES
from graspd.service.model.transforms import apply
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.surface import sample_surface
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.planners import synthesize
from graspd.worker.planners.port import PlanRequest

#: Mean distance between the same surface points of two hands [m]. A difference of 5 mm is seen at a glance.
ALIKE_M = 0.005


def test_no_two_grasps_of_a_batch_are_alike() -> None:
    hand = hand_from_path("allegro")
    found = synthesize(hand, object_from_path("block"), PlanRequest(count=32, fidelity=FIDELITIES["draft"]))
    points = sample_surface(hand, 200)
    poses = body_poses(hand, found.grasp.hand_pose, found.grasp.joint_positions)
    world = apply(poses[:, points.body], points.position)
    distance = np.linalg.norm(world[:, None] - world[None], axis=-1).mean(axis=-1)
    assert distance[np.triu_indices(32, 1)].min() > ALIKE_M


@pytest.mark.slow
def test_memory_is_flat_over_a_thousand_batches() -> None:
    hand, obj = hand_from_path("barrett"), object_from_path("block")
    tiny = FIDELITIES["draft"].model_copy(
        update={"starts": 1, "finalists": 1, "coarse_iterations": 3, "fine_iterations": 2, "polish_iterations": 1}
    )

    def run(first: int, count: int) -> int:
        for batch in range(first, first + count):
            synthesize(hand, obj, PlanRequest(count=4, fidelity=tiny, batch=batch), ExecutionContext(threads=2))
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    warm = run(0, 100)
    grown_mb = (run(100, 1000) - warm) / 1024
    # Fragments of the allocator settle within the first hundred batches; a leak of one array a batch would be 40 MB.
    assert grown_mb < 20
