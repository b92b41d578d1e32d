"""CoreSharing of a batch and parts of its rounds: faster, and the same grasps, verdicts and metrics to the last bit."""

from __future__ import annotations

import threading
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from graspd.service.model.domain import JobOptions
from graspd.service.model.errors import TaskCancelled
from graspd.service.model.fidelity import resolve_fidelity
from graspd.service.model.scene_spec import SceneSpec
from graspd.worker import generation
from graspd.worker.execution_context import CoreSharing, ExecutionContext, parallel_map
from graspd.worker.generation import validated_grasps
from graspd.worker.grasps import GraspSet
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.planners import NoStartFound, PlanRequest
from graspd.worker.rounds import SMALLEST_PART, parts_of
from graspd.worker.scenes.kinds import rest_poses, supports_of
from graspd.worker.simulation.environment import Scenes
from tests.worker.batches import assert_same_batch

REQUEST = JobOptions(fidelity=resolve_fidelity("draft"), rechecks=2, seed=3)
COUNT = 2 * SMALLEST_PART


@pytest.fixture(scope="module")
def pair():
    return hand_from_path("barrett"), object_from_path("block", face_error_m=REQUEST.knobs.face_error_m)


@pytest.fixture(scope="module")
def scenes(pair) -> Scenes:
    table = SceneSpec(kind="table")
    return Scenes(supports_of(table), rest_poses(table, pair[1], count=3, seed=1)["scene/object_pose"])


def noted(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int, int]]:
    """Round, first grasp and number of grasps of each call of the planner from now on."""
    calls: list[tuple[int, int, int]] = []
    whole = generation.synthesize

    def plan(hand: Any, obj: Any, wanted: PlanRequest, *rest: Any, **named: Any) -> GraspSet:
        calls.append((wanted.batch // generation.ROUND_STRIDE, wanted.first, wanted.count))
        return whole(hand, obj, wanted, *rest, **named)

    monkeypatch.setattr(generation, "synthesize", plan)
    return calls


@pytest.mark.parametrize("in_scenes", [False, True])
def test_grasps_of_several_lanes_are_those_of_one(pair, scenes, monkeypatch, in_scenes: bool) -> None:
    wish = REQUEST.model_copy(update={"budget": 1.5, "rechecks": 0}) if in_scenes else REQUEST
    calls, around = noted(monkeypatch), scenes if in_scenes else None
    two, one = (
        validated_grasps(*pair, wish, count=COUNT, scenes=around, run=ExecutionContext(threads=n)) for n in (2, 1)
    )
    assert {(0, 0, SMALLEST_PART), (0, SMALLEST_PART, SMALLEST_PART)} <= set(calls)
    assert_same_batch(two, one)


def test_a_round_ends_as_soon_as_enough_are_found(pair, monkeypatch: pytest.MonkeyPatch) -> None:
    """A round has eight grasps at least; the first few of it are often enough, and the others are never planned."""
    whole = generation.validate

    def strict(hand: Any, obj: Any, grasps: GraspSet, **named: Any) -> Any:
        verdicts = whole(hand, obj, grasps, **named)
        return replace(verdicts, success=verdicts.success * (verdicts.margin < np.median(margins)).astype(np.int8))

    # A seed with which a second round is begun and not ended: five of six tried.
    wish = REQUEST.model_copy(update={"rechecks": 0, "seed": 4})
    margins = validated_grasps(*pair, wish, count=6, run=ExecutionContext(threads=1)).columns["quality/verdict_margin"]
    monkeypatch.setattr(generation, "validate", strict)
    calls = noted(monkeypatch)
    parts = validated_grasps(*pair, wish, count=6, run=ExecutionContext(threads=1))
    assert any(first > 0 or count < 8 for number, first, count in calls if number > 0)
    monkeypatch.setattr(generation.Batch, "_in_parts", False)
    rounds = validated_grasps(*pair, wish, count=6, run=ExecutionContext(threads=1))
    assert parts.planned <= rounds.planned
    assert_same_batch(parts, rounds)


def test_lane_without_a_place_ends_blocked_where_another_has_one(pair, scenes, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = generation.synthesize
    refused: list[int] = []

    def narrow(hand: Any, obj: Any, wanted: PlanRequest, *rest: Any, **named: Any) -> GraspSet:
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
    recheck = generation.Batch._rechecked
    monkeypatch.setattr(
        generation.Batch, "_rechecked", lambda work, some: (rechecked.append(some), recheck(work, some))[1]
    )
    found = validated_grasps(*pair, REQUEST, count=COUNT, run=ExecutionContext(threads=2))
    (first,) = (some.moved(pair[1].centre) for some in rechecked)  # the engine works about the middle of the object
    np.testing.assert_array_equal(first.grasp.hand_pose, found.grasps.grasp.hand_pose[:2])
    np.testing.assert_array_equal(found.columns["quality/recheck"] >= 0, np.arange(COUNT) < 2)


@pytest.mark.parametrize(
    ("rows", "cores", "sizes"),
    [(range(32), 2, [16, 16]), (range(32), 16, [8] * 4), (range(5, 9), 4, [4]), (range(20), 2, [10, 10])],
)
def test_parts_are_as_many_as_cores_and_none_is_small(rows: range, cores: int, sizes: list[int]) -> None:
    parts = parts_of(rows, cores)
    assert [len(part) for part in parts] == sizes
    assert [row for part in parts for row in part] == list(rows)


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

    parallel_map(
        [0, 1, 2], work, ExecutionContext(progress=lambda done, total, _: told.append(done / total)), size=lambda _: 2
    )
    assert told[-1] == max(told) == pytest.approx(1.0) and len(told) == 3
    with pytest.raises(TaskCancelled):
        parallel_map([0, 1], work, ExecutionContext(cancelled=lambda: True), size=lambda _: 1)
