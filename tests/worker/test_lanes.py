"""Lanes of a batch and parts of its rounds: faster, and the same grasps, verdicts and metrics to the last bit."""

from __future__ import annotations

import threading
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from service.model.domain import JobOptions
from service.model.errors import TaskCancelled
from service.model.fidelity import resolve_fidelity
from service.model.scene_spec import SceneSpec
from worker import certified
from worker.certified import Certified, certified_grasps
from worker.grasps import GraspSet
from worker.hands.load import hand_from_path
from worker.objects.prepare import object_from_path
from worker.planners import NoPlace, Wanted, synthesize
from worker.rounds import LANE, lanes_of
from worker.run import Lanes, Run
from worker.scenes.kinds import rest_poses, supports_of
from worker.side_by_side import side_by_side
from worker.simulation.surroundings import Scenes

REQUEST = JobOptions(fidelity=resolve_fidelity("draft"), audits=2, seed=3)
COUNT = 2 * LANE


@pytest.fixture(scope="module")
def pair():
    return hand_from_path("barrett"), object_from_path("block", face_error_m=REQUEST.knobs.face_error_m)


@pytest.fixture(scope="module")
def scenes(pair) -> Scenes:
    table = SceneSpec(kind="table")
    return Scenes(supports_of(table), rest_poses(table, pair[1], count=3, seed=1)["scene/object_pose"])


@pytest.fixture(scope="module")
def one_lane(pair) -> Certified:
    return certified_grasps(*pair, REQUEST, count=COUNT, run=Run(threads=1))


def assert_same(found: Certified, other: Certified) -> None:
    assert (found.tried, found.rejected, found.verdict_key) == (other.tried, other.rejected, other.verdict_key)
    columns, others = (one.grasps.to_columns() | one.columns for one in (found, other))
    assert columns.keys() == others.keys()
    for name, values in others.items():
        np.testing.assert_array_equal(columns[name], values, err_msg=name)


def noted(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int, int]]:
    """Round, first grasp and number of grasps of each call of the planner from now on."""
    calls: list[tuple[int, int, int]] = []
    whole = certified.synthesize

    def plan(hand: Any, obj: Any, wanted: Wanted, *rest: Any, **named: Any) -> GraspSet:
        calls.append((wanted.batch // certified.ROUND_STRIDE, wanted.first, wanted.count))
        return whole(hand, obj, wanted, *rest, **named)

    monkeypatch.setattr(certified, "synthesize", plan)
    return calls


def test_grasps_of_several_lanes_are_those_of_one(pair, one_lane, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = noted(monkeypatch)
    found = certified_grasps(*pair, REQUEST, count=COUNT, run=Run(threads=2))
    assert sorted(calls)[:2] == [(0, 0, LANE), (0, LANE, LANE)]
    assert_same(found, one_lane)


def test_grasps_of_several_lanes_in_scenes_are_those_of_one(pair, scenes, monkeypatch: pytest.MonkeyPatch) -> None:
    wish = REQUEST.model_copy(update={"budget": 1.5, "audits": 0})
    calls = noted(monkeypatch)
    one, two = (certified_grasps(*pair, wish, count=COUNT, scenes=scenes, run=Run(threads=n)) for n in (1, 2))
    assert (0, LANE, LANE) in calls
    assert_same(two, one)
    np.testing.assert_array_equal(two.grasps.scene, one.grasps.scene)


def test_a_round_ends_as_soon_as_enough_are_found(pair, monkeypatch: pytest.MonkeyPatch) -> None:
    """A round has eight grasps at least; the first few of it are often enough, and the others are never planned."""
    whole = certified.judge

    def strict(hand: Any, obj: Any, grasps: GraspSet, **named: Any) -> Any:
        verdicts = whole(hand, obj, grasps, **named)
        return replace(verdicts, success=verdicts.success * (verdicts.margin < np.median(margins)).astype(np.int8))

    # A seed with which a second round is begun and not ended: five of six tried.
    wish = REQUEST.model_copy(update={"audits": 0, "seed": 4})
    margins = certified_grasps(*pair, wish, count=6, run=Run(threads=1)).columns["quality/verdict_margin"]
    monkeypatch.setattr(certified, "judge", strict)
    calls = noted(monkeypatch)
    parts = certified_grasps(*pair, wish, count=6, run=Run(threads=1))
    assert any(first > 0 or count < 8 for number, first, count in calls if number > 0)
    monkeypatch.setattr(certified._Work, "_in_parts", False)
    rounds = certified_grasps(*pair, wish, count=6, run=Run(threads=1))
    assert parts.planned <= rounds.planned
    assert_same(parts, rounds)


def test_lane_without_a_place_ends_blocked_where_another_has_one(pair, scenes, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = certified.synthesize
    refused: list[int] = []

    def narrow(hand: Any, obj: Any, wanted: Wanted, *rest: Any, **named: Any) -> GraspSet:
        if wanted.first in without and not wanted.others_have_place:
            refused.append(wanted.first)
            raise NoPlace("no place")
        return whole(hand, obj, wanted, *rest, **named)

    wish = REQUEST.model_copy(update={"want": "raw", "referee": "none"})
    without: tuple[int, ...] = ()
    free = certified_grasps(*pair, wish, count=COUNT, scenes=scenes, run=Run(threads=2))
    monkeypatch.setattr(certified, "synthesize", narrow)
    without = (LANE,)
    found = certified_grasps(*pair, wish, count=COUNT, scenes=scenes, run=Run(threads=2))
    assert refused == [LANE]
    assert_same(found, free)
    without = (0, LANE)
    with pytest.raises(NoPlace):
        certified_grasps(*pair, wish, count=COUNT, scenes=scenes, run=Run(threads=2))


@pytest.mark.parametrize("first", [0, 3])
def test_grasps_from_one_of_a_batch_on_are_those_of_the_whole(pair, first: int) -> None:
    whole = synthesize(*pair, Wanted(5, REQUEST.knobs, seed=2), Run(threads=1))
    rest = synthesize(*pair, Wanted(5 - first, REQUEST.knobs, seed=2, first=first), Run(threads=2))
    np.testing.assert_array_equal(rest.grasp.hand_pose, whole.grasp.hand_pose[first:])
    np.testing.assert_array_equal(rest.squeeze.joint_positions, whole.squeeze.joint_positions[first:])


def test_the_first_valid_grasps_are_audited_whoever_finds_them(pair, one_lane, monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[int] = []
    whole = certified._Work._begin_audits
    monkeypatch.setattr(
        certified._Work, "_begin_audits", lambda work, first: (begun.append(len(first.grasps)), whole(work, first))
    )
    audited: list[GraspSet] = []
    audit = certified._Work._audited
    monkeypatch.setattr(certified._Work, "_audited", lambda work, some: (audited.append(some), audit(work, some))[1])
    found = certified_grasps(*pair, REQUEST, count=COUNT, run=Run(threads=2))
    assert len(begun) == len(audited) == 1
    first = audited[0].moved(pair[1].centre)  # the engine works about the middle of the object
    np.testing.assert_array_equal(first.grasp.hand_pose, found.grasps.grasp.hand_pose[:2])
    np.testing.assert_array_equal(found.columns["quality/audit"] >= 0, np.arange(COUNT) < 2)
    np.testing.assert_array_equal(found.columns["quality/audit"], one_lane.columns["quality/audit"])
    monkeypatch.setattr(certified._Work, "_begin_audits", lambda work, first: None)
    late = certified_grasps(*pair, REQUEST, count=COUNT, run=Run(threads=2))
    np.testing.assert_array_equal(found.columns["quality/audit"], late.columns["quality/audit"])


@pytest.mark.parametrize(
    ("rows", "cores", "sizes"),
    [(range(32), 2, [16, 16]), (range(32), 16, [8] * 4), (range(5, 9), 4, [4]), (range(20), 2, [10, 10])],
)
def test_lanes_are_as_many_as_there_are_cores_and_none_is_small(rows: range, cores: int, sizes: list[int]) -> None:
    lanes = lanes_of(rows, cores)
    assert [len(lane) for lane in lanes] == sizes
    assert [row for lane in lanes for row in lane] == list(rows)


def test_a_lane_that_ends_leaves_its_cores_to_the_others() -> None:
    ended, both = threading.Event(), threading.Barrier(2, timeout=10)

    class Watched(Lanes):
        def leave(self) -> None:
            super().leave()
            ended.set()

    def work(part: int, run: Run) -> list[int]:
        shared = run.cores
        both.wait()
        if part == 1:
            assert ended.wait(10)
        return [shared, run.cores]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("worker.side_by_side.Lanes", Watched)
        assert side_by_side([0, 1], work, Run(threads=4), size=lambda _: 1)[1] == [2, 4]


def test_a_lane_that_fails_stops_the_others() -> None:
    began = threading.Event()

    def work(part: int, run: Run) -> None:
        if part == 0:
            assert began.wait(10)
            raise ValueError("the first")
        began.set()
        while True:
            run.check("a lane")
            threading.Event().wait(0.01)

    with pytest.raises(ValueError, match="the first"):
        side_by_side([0, 1], work, Run(), size=lambda _: 1)


def test_lanes_tell_how_far_they_are_and_are_cancelled_as_one() -> None:
    told: list[float] = []

    def work(part: int, run: Run) -> None:
        run.progress(1.0, 1.0, "done")
        run.check("a lane")

    side_by_side([0, 1, 2], work, Run(progress=lambda done, total, _: told.append(done / total)), size=lambda _: 2)
    assert told[-1] == max(told) == pytest.approx(1.0) and len(told) == 3
    with pytest.raises(TaskCancelled):
        side_by_side([0, 1], work, Run(cancelled=lambda: True), size=lambda _: 1)
