"""Batches that are made in one launch: each comes out as by itself, whatever becomes of the others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graspd.service.model.errors import InputError, MeshError, TaskCancelled
from graspd.service.model.fidelity import resolve_fidelity
from graspd.service.model.scene_spec import SceneSpec
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.grasps import GraspSet
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.planners import BatchRequest, PlanRequest, synthesize
from graspd.worker.planners.fast_graspd import planner
from graspd.worker.planners.fast_graspd.planner import plan_joined
from graspd.worker.scenes.kinds import rest_poses, supports_of
from graspd.worker.simulation.environment import PlacedGrasps
from tests.worker.batches import assert_same_grasps

QUICK = resolve_fidelity("draft").model_copy(
    update={"coarse_iterations": 20, "fine_iterations": 6, "polish_iterations": 2}
)
TABLE = SceneSpec(kind="table")


@pytest.fixture(scope="module")
def pair():
    return hand_from_path("barrett"), object_from_path("block", face_error_m=QUICK.face_error_m)


ONE = ExecutionContext(threads=1)


def made(pair, wanted: list[PlanRequest], *runs: ExecutionContext) -> list[GraspSet | Exception]:
    """The batches of one launch; those beyond the given contexts have one thread."""
    return plan_joined(*pair, list(map(BatchRequest, wanted, [*runs, *[ONE] * (len(wanted) - len(runs))])))


def assert_same(one: GraspSet | Exception, other: GraspSet) -> None:
    """Bit for bit, with what the planner remarks."""
    assert_same_grasps(one, other)
    assert isinstance(one, GraspSet) and one.info == other.info


@pytest.mark.parametrize("threads", [1, 2])
def test_joined_batches_are_those_of_separate_launches(pair, threads: int) -> None:
    wanted = [PlanRequest(5, QUICK, 1, 0), PlanRequest(3, QUICK, 1, 1), PlanRequest(4, QUICK, 7, 1 << 20)]
    for one, alone in zip(made(pair, wanted, *[ExecutionContext(threads=threads)] * 3), wanted, strict=True):
        assert_same(one, synthesize(*pair, alone, ONE))


def test_a_launch_without_memory_is_halved_across_batches(pair, monkeypatch: pytest.MonkeyPatch) -> None:
    wanted = [PlanRequest(3, QUICK, 1, 0), PlanRequest(3, QUICK, 1, 1)]
    alone = [synthesize(*pair, one, ONE) for one in wanted]

    class Small(planner.Data):
        """Of a device with room for two grasps."""

        def __init__(self, model: object, capacity: int) -> None:
            if capacity > 2 * QUICK.starts:
                raise RuntimeError("Failed to allocate 8589934592 bytes on device 'cuda:0'")
            super().__init__(model, capacity)  # type: ignore[arg-type]

    monkeypatch.setattr(planner, "Data", Small)
    for one, other in zip(made(pair, wanted), alone, strict=True):
        assert_same(one, other)


def on_table(obj, count: int, seed: int) -> PlacedGrasps:
    poses = rest_poses(TABLE, obj, count=2, seed=seed)["scene/object_pose"]
    return PlacedGrasps(supports_of(TABLE), poses, np.arange(count) % 2)


def good_enough(grasps: GraspSet, *_: object) -> np.ndarray:
    return np.zeros(len(grasps))


def test_what_is_matter_with_one_batch_leaves_others_as_they_are(pair) -> None:
    hand, obj = pair
    below = on_table(obj, 2, 3)
    below = replace(below, object_pose=below.object_pose - np.array([0, 0, 1.0, 0, 0, 0, 0]))

    def torn(*_: object) -> np.ndarray:
        raise MeshError("no pieces")

    wanted = [
        PlanRequest(2, QUICK, 1, 0, below, good_enough),
        PlanRequest(3, QUICK, 1, 1, on_table(obj, 3, 3), good_enough),
        PlanRequest(2, QUICK, 1, 2, on_table(obj, 2, 3), torn),
        PlanRequest(2, QUICK, 1, 3, on_table(obj, 2, 3), good_enough),
        PlanRequest(3, QUICK, 2, 0, on_table(obj, 3, 4), good_enough),
    ]
    stopping = ExecutionContext(threads=1, cancelled=lambda: True)
    buried, first, broken, stopped, last = made(pair, wanted, ONE, ONE, ONE, stopping)
    assert isinstance(buried, InputError) and "nothing can reach" in str(buried)
    assert isinstance(broken, MeshError) and isinstance(stopped, TaskCancelled)
    for joined, alone in ((first, wanted[1]), (last, wanted[4])):
        assert_same(joined, synthesize(hand, obj, alone, ONE))


def test_a_batch_that_is_cancelled_leaves_the_others_alone(pair) -> None:
    wanted = [PlanRequest(2, QUICK, 1, 0), PlanRequest(2, QUICK, 1, 1)]
    told: list[str] = []

    def tell(done: float, total: float, message: str) -> None:
        told.append(message)

    stopping = ExecutionContext(threads=1, progress=tell, cancelled=lambda: any("coarse" in one for one in told))
    stopped, kept = made(pair, wanted, stopping)
    assert isinstance(stopped, TaskCancelled) and told == ["starts", "coarse optimization"]
    assert_same(kept, synthesize(*pair, wanted[1], ONE))
    # Where all are cancelled the launch ends.
    told.clear()
    run = ExecutionContext(threads=1, progress=tell, cancelled=lambda: bool(told))
    assert all(isinstance(one, TaskCancelled) for one in made(pair, wanted, run, run)) and told == ["starts"]
