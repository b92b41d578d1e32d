"""What every method promises of its grasps, whatever it searches with."""

from __future__ import annotations

import numpy as np
import pytest

from graspd.service.model.errors import TaskCancelled
from graspd.service.model.fidelity import FIDELITIES
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.grasps import GraspSet
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.planners import PLANNERS, method, synthesize
from graspd.worker.planners.port import PlanRequest

#: All methods around free objects, with the options that make them quick.
PEERS: dict[str, dict[str, object]] = {name: dict(method(name).quick) for name in PLANNERS if method(name).free}
PEERS["graspd2022"]["grid"] = 24
ONE = ExecutionContext(threads=1)
EACH = pytest.mark.parametrize("name", sorted(PEERS))


def grasps(
    name: str, count: int, *, run: ExecutionContext = ONE, seed: int = 0, batch: int = 0, hand: str = "barrett"
) -> GraspSet:
    wanted, obj = PlanRequest(count, FIDELITIES["draft"], seed, batch), object_from_path("block")
    return synthesize(hand_from_path(hand), obj, wanted, run, method=name, options=PEERS[name])


@EACH
def test_a_grasp_depends_on_seed_batch_and_index_alone(name: str) -> None:
    small, large, other = grasps(name, 2), grasps(name, 3, run=ExecutionContext(threads=2)), grasps(name, 2, seed=1)
    assert np.array_equal(small.grasp.hand_pose, large.grasp.hand_pose[:2])
    assert np.array_equal(small.grasp.joint_positions, large.grasp.joint_positions[:2])
    assert not np.allclose(small.grasp.hand_pose, other.grasp.hand_pose)
    assert not np.allclose(small.grasp.hand_pose, grasps(name, 2, batch=1).grasp.hand_pose)


@EACH
def test_grasps_respect_joint_limits_and_unit_quaternions(name: str) -> None:
    model = hand_from_path("allegro")
    found = grasps(name, 2, hand="allegro")
    q = model.reduce(found.grasp.joint_positions)
    assert np.all(q >= model.lower - 1e-5) and np.all(q <= model.upper + 1e-5)
    np.testing.assert_allclose(np.linalg.norm(found.grasp.hand_pose[:, 3:], axis=1), 1, atol=1e-6)


@EACH
def test_cancelling_stops_at_the_first_look(name: str) -> None:
    calls: list[float] = []
    run = ExecutionContext(
        threads=1, progress=lambda done, total, message: calls.append(done), cancelled=lambda: bool(calls)
    )
    with pytest.raises(TaskCancelled):
        grasps(name, 2, run=run)
    assert len(calls) == 1
