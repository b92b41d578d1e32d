"""Several batches of a job at once: the same grasps, and one failure for all."""

from __future__ import annotations

import numpy as np
import pytest

from graspd.service.model.domain import JobOptions
from graspd.service.model.errors import MeshError, TaskCancelled
from graspd.service.model.fidelity import resolve_fidelity
from graspd.worker import together
from graspd.worker.engines.joins import batches_at_once, fitting
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.files.synthesis import synthesized
from graspd.worker.hands.load import hand_from_path
from graspd.worker.meeting import Meeting
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.pool.pool import MODULES, Pool
from graspd.worker.together import validated_batches

REQUEST = JobOptions(fidelity=resolve_fidelity("draft"), rechecks=0, grasps=6)


@pytest.fixture(scope="module")
def pair():
    return hand_from_path("barrett"), object_from_path("block", face_error_m=REQUEST.knobs.face_error_m)


@pytest.fixture(scope="module")
def alone(pair):
    """Batches done one after the other by this process."""
    return validated_batches(*pair, REQUEST, sizes=[2, 2, 2], run=ExecutionContext(threads=2))


def assert_same(batches, others) -> None:
    for one, other in zip(batches, others, strict=True):
        assert (one.candidates, one.rejected, one.planned, one.verdict_key) == (
            other.candidates,
            other.rejected,
            other.planned,
            other.verdict_key,
        )
        columns = one.grasps.to_columns() | one.columns
        for name, values in (other.grasps.to_columns() | other.columns).items():
            np.testing.assert_array_equal(columns[name], values, err_msg=name)


def test_joined_batches_of_a_job_are_the_same_from_plan_to_verdict(
    pair, alone, monkeypatch: pytest.MonkeyPatch
) -> None:
    launches: list[Meeting] = []

    class Noted(Meeting):
        def __init__(self, *given: int) -> None:
            super().__init__(*given)
            launches.append(self)

    monkeypatch.setattr(together, "Meeting", Noted)
    told: list[tuple[float, float]] = []
    run = ExecutionContext(threads=2, progress=lambda done, total, message: told.append((done, total)))
    joined = validated_batches(*pair, REQUEST, sizes=[2, 2, 2], join=3, run=run)
    assert launches[0].served[0] == 3, "the first launch has all three"
    assert_same(joined, alone)
    assert told[-1] == (6, 6)
    assert all(done <= total for done, total in told)


def test_batches_that_other_processes_judge_and_measure_are_the_same(pair, alone) -> None:
    told: list[tuple[float, float]] = []
    with Pool(2, MODULES) as pool:
        run = ExecutionContext(threads=2, pool=pool, progress=lambda done, total, message: told.append((done, total)))
        assert_same(validated_batches(*pair, REQUEST, sizes=[2, 2, 2], join=2, run=run), alone)
        assert len(pool.pids) == 2
    assert told[-1] == (6, 6)


def test_a_run_in_this_process_makes_the_batches_of_a_job(pair) -> None:
    """Near-duplicates are dropped from a batch, whoever makes it: at this distance two batches are full of them."""
    request = JobOptions(grasps=33, validation="none", fidelity="draft", min_distance=0.03, budget=2, rechecks=0)
    batches = validated_batches(*pair, request, sizes=[32, 1], run=ExecutionContext(threads=2))
    made = synthesized("barrett", "block", request, device="cpu", threads=2)
    assert_same(made.batches, batches)
    assert len(made.arrays["grasp/hand_pose"]) == sum(len(one.grasps) for one in batches)


def test_what_becomes_of_one_batch_ends_the_job(pair) -> None:
    def torn(obj: object) -> object:
        raise MeshError("no pieces")

    with pytest.raises(MeshError, match="no pieces"):
        validated_batches(*pair, REQUEST, sizes=[2, 2], join=2, pieces=torn, run=ExecutionContext(threads=1))  # type: ignore[arg-type]


def test_a_job_that_is_cancelled_stops_all_its_batches(pair) -> None:
    told: list[str] = []
    run = ExecutionContext(
        threads=1, progress=lambda done, total, message: told.append(message), cancelled=lambda: bool(told)
    )
    with pytest.raises(TaskCancelled):
        validated_batches(*pair, REQUEST, sizes=[2, 2], join=2, run=run)


def test_how_many_are_joined_where_nobody_says() -> None:
    assert batches_at_once("cpu", None) == 1
    assert batches_at_once("cpu", 4) == 4
    # Of an H100 and an H200 (132 multiprocessors), of a GPU with 20, and of one whose memory is nearly full.
    assert [fitting(132, 80 << 30), fitting(20, 8 << 30), fitting(132, 1 << 30), fitting(132, 0)] == [32, 4, 4, 1]
