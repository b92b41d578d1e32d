"""Batches on shared cores, in other processes and made together: the same grasps, and nothing that hangs."""

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from graspd.service.model.domain import JobOptions
from graspd.service.model.errors import MeshError, TaskCancelled
from graspd.service.model.fidelity import resolve_fidelity
from graspd.worker import batched_generation, generation
from graspd.worker.batched_generation import validated_batches
from graspd.worker.engines.batch_sizes import (
    BYTES_PER_PROCESS,
    PROCESS_SHARE,
    batches_per_launch,
    batches_that_fit,
    pool_process_count,
)
from graspd.worker.execution_context import CoreSharing, ExecutionContext, parallel_map
from graspd.worker.files.synthesis import synthesize_grasps
from graspd.worker.generation import ValidatedBatch, validated_grasps
from graspd.worker.grasps import GraspSet
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.planners import BatchRequest, NoStartFound, PlanRequest
from graspd.worker.pool.pool import KEPT, MODULES, Pool, ProcessLost
from graspd.worker.rounds import SMALLEST_PART, split_rows
from tests.service.model.test_cores import system
from tests.waiting import until
from tests.worker.models import assert_same_batch, on_tables
from tests.worker.pool import works

REQUEST = JobOptions(fidelity=resolve_fidelity("draft"), rechecks=2, seed=3)
ASKED = REQUEST.model_copy(update={"rechecks": 0, "grasps": 6, "seed": 0})
COUNT = 2 * SMALLEST_PART


@pytest.fixture(scope="module")
def pair():
    return hand_from_path("barrett"), object_from_path("block", face_error_m=REQUEST.resolved_fidelity.face_error_m)


@pytest.fixture(scope="module")
def scenes(pair):
    return on_tables(pair[1], count=3)


def noted(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int, int]]:
    """Round, first grasp and number of grasps of each call of the planner from now on."""
    calls: list[tuple[int, int, int]] = []
    whole = generation.synthesize

    def plan(hand, obj, wanted: PlanRequest, *rest, **named) -> GraspSet:
        calls.append((wanted.batch // generation.ROUND_STRIDE, wanted.first, wanted.count))
        return whole(hand, obj, wanted, *rest, **named)

    monkeypatch.setattr(generation, "synthesize", plan)
    return calls


@pytest.mark.parametrize("in_scenes", [False, True])
def test_grasps_of_several_lanes_are_those_of_one(pair, scenes, monkeypatch, in_scenes: bool) -> None:
    wish = REQUEST.model_copy(update={"budget": 1.5, "rechecks": 0}) if in_scenes else REQUEST
    calls, around = noted(monkeypatch), scenes if in_scenes else None
    runs = (ExecutionContext(threads=2), ExecutionContext(threads=1))
    two, one = (validated_grasps(*pair, wish, count=COUNT, scenes=around, run=run) for run in runs)
    assert {(0, 0, SMALLEST_PART), (0, SMALLEST_PART, SMALLEST_PART)} <= set(calls)
    assert_same_batch(two, one)


def test_a_round_ends_as_soon_as_enough_are_found(pair, monkeypatch: pytest.MonkeyPatch) -> None:
    """A round has eight grasps at least; the first few of it are often enough, and the others are never planned."""
    whole = generation.validate

    def strict(hand, obj, grasps: GraspSet, **named):
        verdicts = whole(hand, obj, grasps, **named)
        return replace(verdicts, success=verdicts.success * (verdicts.margin < np.median(margins)).astype(np.int8))

    # A seed with which a second round is begun and not ended: five of six tried.
    wish = REQUEST.model_copy(update={"rechecks": 0, "seed": 4})
    margins = validated_grasps(*pair, wish, count=6, run=ExecutionContext(threads=1)).columns["quality/verdict_margin"]
    monkeypatch.setattr(generation, "validate", strict)
    calls = noted(monkeypatch)
    parts = validated_grasps(*pair, wish, count=6, run=ExecutionContext(threads=1))
    assert any(first > 0 or count < 8 for number, first, count in calls if number > 0)
    monkeypatch.setattr(generation.Batch, "_is_divisible", False)
    rounds = validated_grasps(*pair, wish, count=6, run=ExecutionContext(threads=1))
    assert parts.planned <= rounds.planned
    assert_same_batch(parts, rounds)


def test_lane_without_a_place_ends_blocked_where_another_has_one(pair, scenes, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = generation.synthesize
    refused: list[int] = []

    def narrow(hand, obj, wanted: PlanRequest, *rest, **named) -> GraspSet:
        if wanted.first in without and not wanted.others_have_place:
            refused.append(wanted.first)
            raise NoStartFound("no place")
        return whole(hand, obj, wanted, *rest, **named)

    wish = REQUEST.model_copy(update={"want": "candidates", "validation": "none"})
    without: tuple[int, ...] = ()
    free = validated_grasps(*pair, wish, count=COUNT, scenes=scenes, run=ExecutionContext(threads=2))
    monkeypatch.setattr(generation, "synthesize", narrow)
    without = (SMALLEST_PART,)
    found = validated_grasps(*pair, wish, count=COUNT, scenes=scenes, run=ExecutionContext(threads=2))
    assert refused == [SMALLEST_PART]
    assert_same_batch(found, free)
    without = (0, SMALLEST_PART)
    with pytest.raises(NoStartFound):
        validated_grasps(*pair, wish, count=COUNT, scenes=scenes, run=ExecutionContext(threads=2))


def test_the_first_valid_grasps_are_audited_whoever_finds_them(pair, monkeypatch: pytest.MonkeyPatch) -> None:
    rechecked: list[GraspSet] = []
    recheck = generation.Batch._recheck
    told = lambda work, some: (rechecked.append(some), recheck(work, some))[1]  # noqa: E731
    monkeypatch.setattr(generation.Batch, "_recheck", told)
    found = validated_grasps(*pair, REQUEST, count=COUNT, run=ExecutionContext(threads=2))
    (first,) = (some.moved(pair[1].centre) for some in rechecked)  # the engine works about the middle of the object
    np.testing.assert_array_equal(first.grasp.hand_pose, found.grasps.grasp.hand_pose[:2])
    np.testing.assert_array_equal(found.columns["quality/recheck"] >= 0, np.arange(COUNT) < 2)


@pytest.mark.parametrize(
    ("rows", "cores", "sizes"),
    [(range(32), 2, [16, 16]), (range(32), 16, [8] * 4), (range(5, 9), 4, [4]), (range(20), 2, [10, 10])],
)
def test_parts_are_as_many_as_cores_and_none_is_small(rows: range, cores: int, sizes: list[int]) -> None:
    parts = split_rows(rows, cores)
    assert [len(part) for part in parts] == sizes and [row for part in parts for row in part] == list(rows)


def test_a_lane_that_ends_leaves_its_cores_to_the_others() -> None:
    ended, both = threading.Event(), threading.Barrier(2, timeout=10)

    class Watched(CoreSharing):
        def leave(self) -> None:
            super().leave()
            ended.set()

    def work(part: int, run: ExecutionContext) -> list[int]:
        shared = run.cores
        both.wait()
        if part == 1:
            assert ended.wait(10)
        return [shared, run.cores]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("graspd.worker.execution_context.CoreSharing", Watched)
        assert parallel_map([0, 1], work, ExecutionContext(threads=4), size=lambda _: 1)[1] == [2, 4]


def test_a_lane_that_fails_stops_the_others() -> None:
    began = threading.Event()

    def work(part: int, run: ExecutionContext) -> None:
        if part == 0:
            assert began.wait(10)
            raise ValueError("the first")
        began.set()
        while True:
            run.check("a priority")
            threading.Event().wait(0.01)

    with pytest.raises(ValueError, match="the first"):
        parallel_map([0, 1], work, ExecutionContext(), size=lambda _: 1)


def test_parts_report_progress_and_are_cancelled_as_one() -> None:
    told: list[float] = []

    def work(part: int, run: ExecutionContext) -> None:
        run.progress(1.0, 1.0, "done")
        run.check("a priority")

    run = ExecutionContext(progress=lambda done, total, _: told.append(done / total))
    parallel_map([0, 1, 2], work, run, size=lambda _: 2)
    assert told[-1] == max(told) == pytest.approx(1.0) and len(told) == 3
    with pytest.raises(TaskCancelled):
        parallel_map([0, 1], work, ExecutionContext(cancelled=lambda: True), size=lambda _: 1)


@pytest.fixture(scope="module")
def alone(pair):
    """Batches done one after the other by this process."""
    return validated_batches(*pair, ASKED, sizes=[2, 2, 2], run=ExecutionContext(threads=2))


def assert_same(batches, others) -> None:
    for one, other in zip(batches, others, strict=True):
        assert one.planned == other.planned
        assert_same_batch(one, other)


def test_joined_batches_of_a_job_are_the_same_from_plan_to_verdict(pair, alone, monkeypatch) -> None:
    launches, whole = list[list[int]](), batched_generation.synthesize_batches

    def noted(hand, obj, asked: Sequence[BatchRequest], **named):
        launches.append([one.wanted.batch for one in asked])
        return whole(hand, obj, asked, **named)

    monkeypatch.setattr(batched_generation, "synthesize_batches", noted)
    told: list[tuple[float, float]] = []
    run = ExecutionContext(threads=2, progress=lambda done, total, message: told.append((done, total)))
    joined = validated_batches(*pair, ASKED, sizes=[2, 2, 2], join=3, run=run)
    assert launches[0] == [0, 1, 2], "the first launch has all three"
    assert_same(joined, alone)
    assert told[-1] == (6, 6) and all(done <= total for done, total in told)


def test_batches_that_other_processes_judge_and_measure_are_the_same(pair, alone) -> None:
    told: list[tuple[float, float]] = []
    with Pool(2, MODULES) as pool:
        run = ExecutionContext(threads=2, pool=pool, progress=lambda done, total, message: told.append((done, total)))
        assert_same(validated_batches(*pair, ASKED, sizes=[2, 2, 2], join=2, run=run), alone)
        assert len(pool.pids) == 2
    assert told[-1] == (6, 6)


def test_a_run_in_this_process_makes_the_batches_of_a_job(pair) -> None:
    """Near-duplicates are dropped from a batch, whoever makes it: at this distance two batches are full of them."""
    quick = REQUEST.fidelity.model_copy(update={"coarse_iterations": 20, "fine_iterations": 6, "polish_iterations": 2})
    request = JobOptions(grasps=33, validation="none", fidelity=quick, min_distance=0.03, budget=2, rechecks=0)
    batches = validated_batches(*pair, request, sizes=[32, 1], run=ExecutionContext(threads=2))
    made = synthesize_grasps("barrett", "block", request, device="cpu", threads=2)
    assert_same(made.batches, batches)
    assert len(made.arrays["grasp/hand_pose"]) == sum(len(one.grasps) for one in batches)


@pytest.fixture(scope="module")
def own_scenes(pair):
    whole = on_tables(pair[1], count=6)
    return [replace(whole, object_pose=whole.object_pose[first : first + 2]) for first in (0, 2, 4)]


@pytest.mark.parametrize("apart", [True, False])
def test_waves_of_batches_in_scenes_are_the_same(pair, own_scenes, apart: bool) -> None:
    wish = ASKED.model_copy(update={"budget": 3.0, "rechecks": 1})
    where, sizes = own_scenes if apart else own_scenes[0], [2, 2, 3]
    given = {"sizes": sizes, "scenes": where, "run": ExecutionContext(threads=2)}
    one_by_one, waves = (validated_batches(*pair, wish, **given, join=join) for join in (1, 2))
    assert_same(waves, one_by_one)
    assert [one.shares for one in waves] == [one.shares for one in one_by_one]
    assert set(np.concatenate([one.grasps.scene for one in waves])) <= {0, 1}, "numbered as the batch has them"


@pytest.mark.parametrize(("refused", "first"), [({0}, 0), ({1}, 0), ({0, 1}, 4)])
def test_a_batch_without_a_place_has_no_grasps_but_for_the_first(pair, own_scenes, monkeypatch, refused, first) -> None:
    whole = batched_generation.synthesize_batches

    def narrow(hand, obj, asked: Sequence[BatchRequest], **named):
        made = whole(hand, obj, asked, **named)
        return [NoStartFound("no way in") if k in refused else grasps for k, grasps in enumerate(made)]

    monkeypatch.setattr(batched_generation, "synthesize_batches", narrow)
    wish = ASKED.model_copy(update={"validation": "none", "want": "candidates"})
    asked = {"sizes": [2, 2], "scenes": own_scenes[:2], "join": 2, "empty_on": (NoStartFound,), "first": first}
    with nullcontext() if refused == {1} else pytest.raises(NoStartFound, match="no way in"):
        made = validated_batches(*pair, wish, **asked, run=ExecutionContext(threads=2))
        assert [len(one.grasps) for one in made] == [2, 0]


def test_what_was_validated_before_a_stop_is_kept(pair, alone) -> None:
    stopped: list[bool] = []

    def one_is_made(number: int, made: ValidatedBatch) -> None:
        stopped.append(True)

    run = ExecutionContext(threads=2, cancelled=lambda: bool(stopped))
    found = validated_batches(*pair, ASKED, sizes=[2, 32, 32], join=2, run=run, partial=True, checked=one_is_made)
    assert_same(found[:1], alone[:1])
    assert sum(len(one.grasps) for one in found) < 66


def test_what_becomes_of_one_batch_ends_the_job(pair) -> None:
    def torn(obj: object) -> object:
        raise MeshError("no pieces")

    with pytest.raises(MeshError, match="no pieces"):
        validated_batches(*pair, ASKED, sizes=[2, 2], join=2, pieces=torn, run=ExecutionContext(threads=1))  # type: ignore[arg-type]


def test_how_many_are_joined_where_nobody_says() -> None:
    assert batches_per_launch("cpu", None) == 1 and batches_per_launch("cpu", 4) == 4
    # Of an H100 and an H200 (132 multiprocessors), of a GPU with 20, and of one whose memory is nearly full.
    assert [
        batches_that_fit(132, 80 << 30),
        batches_that_fit(20, 8 << 30),
        batches_that_fit(132, 1 << 30),
        batches_that_fit(132, 0),
    ] == [32, 4, 4, 1]


@pytest.fixture(scope="module")
def pool():
    with Pool(2) as made:
        yield made


def alive(pid: int) -> bool:
    try:
        # Threads may outlive the first one, which is a zombie by then.
        states = [file.read_text().rpartition(")")[2].split()[0] for file in Path(f"/proc/{pid}/task").glob("*/stat")]
    except OSError:
        return Path(f"/proc/{pid}").exists()
    return any(state != "Z" for state in states)


def test_results_come_in_the_order_of_their_parts(pool: Pool) -> None:
    told: list[int] = []
    assert pool.map(works.times, "three", 3, range(20), done=told.append) == [3 * part for part in range(20)]
    assert sorted(told) == list(range(20))
    assert pool.map(works.times, "three", 3, []) == []


def test_other_processes_do_it(pool: Pool) -> None:
    found = set(pool.map(works.own_pid, "none", None, range(8)))
    assert found <= set(pool.pids) and os.getpid() not in found


def test_what_was_forgotten_is_sent_again(pool: Pool) -> None:
    for number in (*range(2 * KEPT), *range(2 * KEPT)):
        assert pool.map(works.times, f"factor {number}", number, [1, 1, 1]) == [number] * 3


def test_an_error_comes_as_it_was_raised(pool: Pool) -> None:
    with pytest.raises(ValueError, match="part 2") as found:
        pool.map(works.fail, "part", "part", [0, 2])
    assert "in fail" in found.value.__notes__[0]
    with pytest.raises(RuntimeError, match="Odd: very odd"):
        pool.map(works.fail_oddly, "none", None, [0])


def test_a_process_that_is_killed_fails_what_it_did_and_is_replaced(pool: Pool) -> None:
    with pytest.raises(ProcessLost, match="signal 9"):
        pool.map(works.be_killed, "none", None, [0])
    assert pool.map(works.times, "three", 3, range(6)) == [0, 3, 6, 9, 12, 15]


def test_one_that_was_killed_while_it_waited_is_replaced(pool: Pool) -> None:
    pool.map(works.times, "three", 3, range(6))
    for pid in pool.pids:
        os.kill(pid, signal.SIGKILL)
        until(lambda pid=pid: not alive(pid), "it is dead")
    assert pool.map(works.times, "three", 3, range(6)) == [0, 3, 6, 9, 12, 15]


@pytest.mark.timeout(60)
@pytest.mark.parametrize(("processes", "patience_s"), [(2, 600), (1, 0)], ids=["by another", "by one in its place"])
def test_who_is_cancelled_waits_no_longer_and_others_are_served(processes, patience_s, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("graspd.worker.pool.pool._PATIENCE_S", patience_s)
    with Pool(processes) as pool:
        with pytest.raises(TaskCancelled):
            pool.map(works.hang, "folder", tmp_path, [0], cancelled=lambda: any(tmp_path.iterdir()))
        assert pool.map(works.times, "three", 3, [1, 2]) == [3, 6]
        pids = pool.pids
    assert not any(alive(pid) for pid in pids), "processes end with their pool, whatever they do"
    with pytest.raises(TaskCancelled):
        pool.map(works.times, "three", 3, [1])


def test_processes_end_with_the_one_that_started_them(tmp_path: Path) -> None:
    program = (
        "from pathlib import Path; from graspd.worker.pool.pool import Pool; from tests.worker.pool import works; "
        f"Pool(2).map(works.hang, 'folder', Path({str(tmp_path)!r}), [0, 1])"
    )
    parent = subprocess.Popen([sys.executable, "-c", program])
    try:
        until(lambda: len(list(tmp_path.iterdir())) == 2 or parent.poll() is not None, "both work")
    finally:
        parent.kill()
        parent.wait()
    pids = [int(file.name) for file in tmp_path.iterdir()]
    assert len(pids) == 2
    until(lambda: not any(alive(pid) for pid in pids), "they end")


def machine(root: Path, cores: int, memory: int) -> Path:
    """A root folder as a container of so many cores and so much memory sees it."""
    return system(root, "0::/", {"cpu.max": f"{cores * 100_000} 100000", "memory.max": str(memory)})


def test_how_many_there_are_where_nobody_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: range(64), raising=False)
    monkeypatch.setattr(os, "sysconf", lambda name: {"SC_PAGE_SIZE": 4096, "SC_PHYS_PAGES": 1 << 26}[name])
    room = round(BYTES_PER_PROCESS / PROCESS_SHARE)
    big = machine(tmp_path / "big", 16, 40 * room)
    assert pool_process_count("cuda:0", 0, root=big) == 15
    assert pool_process_count("cuda:1", 0, root=big, workers=4) == 3, "workers of one machine share its cores"
    assert pool_process_count("cuda:0", 0, root=big, threads=5) == 4
    assert pool_process_count("cpu", 0, root=big) == 1, "the planner takes the cores at other times"
    assert [pool_process_count(device, 6, root=big) for device in ("cpu", "cuda:0")] == [6, 6]
    assert pool_process_count("cuda:0", 0, root=machine(tmp_path / "two", 2, 40 * room)) == 1
    assert pool_process_count("cuda:0", 0, root=machine(tmp_path / "poor", 16, 3 * room)) == 3
