"""Several batches of a job at once: the same grasps, and one failure for all."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from service.model.domain import JobOptions
from service.model.errors import InputError, MeshError, TaskCancelled
from service.model.fidelity import resolve_fidelity
from service.model.scene_spec import SceneSpec
from worker import together
from worker.certified import Certified, certified_grasps
from worker.engines.joins import batches_at_once, fitting, parse_join
from worker.files.synthesis import synthesized
from worker.hands.load import hand_from_path
from worker.objects.prepare import object_from_path
from worker.planners import Asked, NoPlace
from worker.pool.pool import MODULES, Pool
from worker.run import Run
from worker.scenes.kinds import rest_poses, supports_of
from worker.simulation.surroundings import Scenes
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
        assert (one.tried, one.rejected, one.planned, one.verdict_key) == (
            other.tried,
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
    launches, whole = list[list[int]](), together.synthesize_batches

    def noted(hand: Any, obj: Any, asked: Sequence[Asked], **named: Any) -> Any:
        launches.append([one.wanted.batch for one in asked])
        return whole(hand, obj, asked, **named)

    monkeypatch.setattr(together, "synthesize_batches", noted)
    told: list[tuple[float, float]] = []
    run = Run(threads=2, progress=lambda done, total, message: told.append((done, total)))
    joined = certified_batches(*pair, REQUEST, sizes=[2, 2, 2], join=3, run=run)
    assert launches[0] == [0, 1, 2], "the first launch has all three"
    assert_same(joined, alone)
    assert told[-1] == (6, 6)
    assert all(done <= total for done, total in told)


def test_batches_that_other_processes_judge_and_measure_are_the_same(pair, alone) -> None:
    told: list[tuple[float, float]] = []
    with Pool(2, MODULES) as pool:
        run = Run(threads=2, pool=pool, progress=lambda done, total, message: told.append((done, total)))
        assert_same(certified_batches(*pair, REQUEST, sizes=[2, 2, 2], join=2, run=run), alone)
        assert len(pool.pids) == 2
    assert told[-1] == (6, 6)


@pytest.fixture(scope="module")
def scenes(pair) -> list[Scenes]:
    """Of each of three batches its own."""
    table = SceneSpec(kind="table")
    poses = rest_poses(table, pair[1], count=6, seed=1)["scene/object_pose"]
    return [Scenes(supports_of(table), poses[first : first + 2]) for first in (0, 2, 4)]


@pytest.mark.parametrize("apart", [True, False])
def test_waves_of_batches_in_scenes_are_the_same(pair, scenes: list[Scenes], apart: bool) -> None:
    wish = REQUEST.model_copy(update={"budget": 3.0, "audits": 1})
    where, sizes = scenes if apart else scenes[0], [2, 2, 3]
    one_by_one, waves = (
        certified_batches(*pair, wish, sizes=sizes, scenes=where, join=join, run=Run(threads=2)) for join in (1, 2)
    )
    assert_same(waves, one_by_one)
    assert [one.shares for one in waves] == [one.shares for one in one_by_one]
    assert set(np.concatenate([one.grasps.scene for one in waves])) <= {0, 1}, "numbered as the batch has them"


@pytest.mark.parametrize("first", [0, 1])
def test_a_batch_of_a_wave_without_a_place_has_no_grasps_but_for_the_first_of_a_job(
    pair, scenes: list[Scenes], monkeypatch: pytest.MonkeyPatch, first: int
) -> None:
    whole = together.synthesize_batches

    def narrow(hand: Any, obj: Any, asked: Sequence[Asked], **named: Any) -> Any:
        made = whole(hand, obj, asked, **named)
        return [
            NoPlace("no way in") if one.wanted.batch == 1 - first else g for one, g in zip(asked, made, strict=True)
        ]

    monkeypatch.setattr(together, "synthesize_batches", narrow)
    wish = REQUEST.model_copy(update={"referee": "none", "want": "raw"})

    def made() -> list[Certified]:
        asked = {"sizes": [2, 2], "scenes": scenes[:2], "join": 2, "run": Run(threads=2), "empty_on": (NoPlace,)}
        return certified_batches(*pair, wish, **asked)

    if first:
        with pytest.raises(NoPlace, match="no way in"):
            made()
    else:
        assert [len(one.grasps) for one in made()] == [2, 0]


def test_what_was_judged_before_a_stop_is_kept(pair, alone) -> None:
    stopped: list[bool] = []

    def one_is_made(number: int, made: Certified) -> None:
        stopped.append(True)

    run = Run(threads=2, cancelled=lambda: bool(stopped))
    found = certified_batches(*pair, REQUEST, sizes=[2, 32, 32], join=2, run=run, partial=True, checked=one_is_made)
    assert_same(found[:1], alone[:1])
    assert sum(len(one.grasps) for one in found) < 66


def test_grasps_alike_in_two_batches_are_replaced_by_those_of_another(pair) -> None:
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


def test_what_becomes_of_one_batch_ends_the_job(pair) -> None:
    def torn(obj: object) -> object:
        raise MeshError("no pieces")

    with pytest.raises(MeshError, match="no pieces"):
        certified_batches(*pair, REQUEST, sizes=[2, 2], join=2, pieces=torn, run=Run(threads=1))  # type: ignore[arg-type]


def test_a_job_that_is_cancelled_stops_all_its_batches(pair) -> None:
    told: list[str] = []
    run = Run(threads=1, progress=lambda done, total, message: told.append(message), cancelled=lambda: bool(told))
    with pytest.raises(TaskCancelled):
        certified_batches(*pair, REQUEST, sizes=[2, 2], join=2, run=run)


def test_how_many_are_joined_where_nobody_says() -> None:
    assert [parse_join(text) for text in ("auto", "1", "32")] == [None, 1, 32]
    assert batches_at_once("cpu", None) == 1
    assert batches_at_once("cpu", 4) == 4
    # Of an H100 and an H200 (132 multiprocessors), of a GPU with 20, and of one whose memory is nearly full.
    assert [fitting(132, 80 << 30), fitting(20, 8 << 30), fitting(132, 1 << 30), fitting(132, 0)] == [32, 4, 4, 1]


@pytest.mark.parametrize("text", ["0", "-1", "many", "1.5", ""])
def test_what_is_no_number_of_batches_is_refused(text: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--join takes a number of batches"):
        synthesized("barrett", str(tmp_path / "none.stl"), REQUEST, join=text)
