"""Several batches of a job at once: the same grasps, and one failure for all."""

from __future__ import annotations

from pathlib import Path

import pytest

from service.model.domain import JobOptions
from service.model.errors import InputError, MeshError, TaskCancelled
from service.model.fidelity import resolve_fidelity
from tests.worker.test_lanes import assert_same as same_batch
from worker import together
from worker.certified import Certified, certified_grasps
from worker.engines.joins import batches_at_once, fitting, parse_join
from worker.files.synthesis import synthesized
from worker.hands.load import hand_from_path
from worker.meeting import Meeting
from worker.objects.prepare import object_from_path
from worker.pool.pool import MODULES, Pool
from worker.run import Run
from worker.together import certified_batches, distinct_batches

REQUEST = JobOptions(fidelity=resolve_fidelity("draft"), audits=0, grasps=6)


@pytest.fixture(scope="module")
def pair():
    return hand_from_path("barrett"), object_from_path("block", face_error_m=REQUEST.knobs.face_error_m)


@pytest.fixture(scope="module")
def alone(pair):
    """Batches done one after the other by this process."""
    return certified_batches(*pair, REQUEST, sizes=[2, 2, 2], run=Run(threads=2))


def assert_same(batches, others) -> None:
    for one, other in zip(batches, others, strict=True):
        assert one.planned == other.planned
        same_batch(one, other)


def test_joined_batches_of_job_are_the_same_from_plan_to_verdict(pair, alone, monkeypatch: pytest.MonkeyPatch) -> None:
    launches: list[Meeting] = []

    class Noted(Meeting):
        def __init__(self, *given: int) -> None:
            super().__init__(*given)
            launches.append(self)

    monkeypatch.setattr(together, "Meeting", Noted)
    told: list[tuple[float, float]] = []
    run = Run(threads=2, progress=lambda done, total, message: told.append((done, total)))
    joined = certified_batches(*pair, REQUEST, sizes=[2, 2, 2], join=3, run=run)
    assert launches[0].served[0] == 3, "the first launch has all three"
    assert_same(joined, alone)
    assert told[-1] == (6, 6)
    assert all(done <= total for done, total in told)


def test_batches_that_other_processes_judge_and_measure_are_same(pair, alone) -> None:
    told: list[tuple[float, float]] = []
    with Pool(2, MODULES) as pool:
        run = Run(threads=2, pool=pool, progress=lambda done, total, message: told.append((done, total)))
        assert_same(certified_batches(*pair, REQUEST, sizes=[2, 2, 2], join=2, run=run), alone)
        assert len(pool.pids) == 2
    assert told[-1] == (6, 6)


def test_grasps_alike_in_two_batches_are_replaced_by_others(pair) -> None:
    request = REQUEST.model_copy(update={"referee": "none"})
    first, third = (certified_batches(*pair, request, sizes=[size], run=Run(threads=2))[0] for size in (2, 3))
    asked: list[tuple[int, int]] = []

    def more(count: int, number: int) -> Certified:
        asked.append((count, number))
        return certified_grasps(*pair, request, count=count, batch=number, run=Run(threads=2))

    found = distinct_batches(pair[0], request, [first, third], more)
    # The second batch begins as the first one does: two of its three are there already.
    assert asked == [(2, 2)] and [len(one.grasps) for one in found] == [2, 1, 2]
    assert found[1].rejected["alike"] == 2 and len(found[1].columns["quality/epsilon"]) == 1
    raw = request.model_copy(update={"want": "raw"})
    assert distinct_batches(pair[0], raw, [first, third], more) == [first, third]


def test_a_batch_that_fails_or_a_cancelled_job_stops_all_batches(pair) -> None:
    def torn(obj: object) -> object:
        raise MeshError("no pieces")

    with pytest.raises(MeshError, match="no pieces"):
        certified_batches(*pair, REQUEST, sizes=[2, 2], join=2, pieces=torn, run=Run(threads=1))  # type: ignore[arg-type]
    told: list[str] = []
    run = Run(threads=1, progress=lambda done, total, message: told.append(message), cancelled=lambda: bool(told))
    with pytest.raises(TaskCancelled):
        certified_batches(*pair, REQUEST, sizes=[2, 2], join=2, run=run)


def test_how_many_are_joined_where_nobody_says(tmp_path: Path) -> None:
    assert [parse_join(text) for text in ("auto", "1", "32")] == [None, 1, 32]
    assert batches_at_once("cpu", None) == 1
    assert batches_at_once("cpu", 4) == 4
    # Of an H100 and an H200 (132 multiprocessors), of a GPU with 20, and of one whose memory is nearly full.
    assert [fitting(132, 80 << 30), fitting(20, 8 << 30), fitting(132, 1 << 30), fitting(132, 0)] == [32, 4, 4, 1]
    for text in ("0", "-1", "many", "1.5", ""):
        with pytest.raises(InputError, match="--join takes a number of batches"):
            synthesized("barrett", str(tmp_path / "none.stl"), REQUEST, join=text)
