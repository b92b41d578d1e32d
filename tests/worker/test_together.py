"""Several batches of a job at once: the same grasps, and one failure for all."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from typing import Any

import numpy as np
import pytest

from graspd.service.model.domain import JobOptions
from graspd.service.model.errors import MeshError
from graspd.service.model.fidelity import resolve_fidelity
from graspd.service.model.scene_spec import SceneSpec
from graspd.worker import together
from graspd.worker.engines.joins import batches_at_once, fitting
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.files.synthesis import synthesized
from graspd.worker.generation import ValidatedBatch
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.planners import BatchRequest, NoStartFound
from graspd.worker.pool.pool import MODULES, Pool
from graspd.worker.scenes.kinds import rest_poses, supports_of
from graspd.worker.simulation.environment import Scenes
from graspd.worker.together import validated_batches
from tests.worker.batches import assert_same_batch

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
        assert one.planned == other.planned
        assert_same_batch(one, other)


def test_joined_batches_of_a_job_are_the_same_from_plan_to_verdict(pair, alone, monkeypatch) -> None:
    launches, whole = list[list[int]](), together.synthesize_batches

    def noted(hand: Any, obj: Any, asked: Sequence[BatchRequest], **named: Any) -> Any:
        launches.append([one.wanted.batch for one in asked])
        return whole(hand, obj, asked, **named)

    monkeypatch.setattr(together, "synthesize_batches", noted)
    told: list[tuple[float, float]] = []
    run = ExecutionContext(threads=2, progress=lambda done, total, message: told.append((done, total)))
    joined = validated_batches(*pair, REQUEST, sizes=[2, 2, 2], join=3, run=run)
    assert launches[0] == [0, 1, 2], "the first launch has all three"
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


@pytest.fixture(scope="module")
def scenes(pair) -> list[Scenes]:
    """Of each of three batches its own."""
    table = SceneSpec(kind="table")
    poses = rest_poses(table, pair[1], count=6, seed=1)["scene/object_pose"]
    return [Scenes(supports_of(table), poses[first : first + 2]) for first in (0, 2, 4)]


@pytest.mark.parametrize("apart", [True, False])
def test_waves_of_batches_in_scenes_are_the_same(pair, scenes: list[Scenes], apart: bool) -> None:
    wish = REQUEST.model_copy(update={"budget": 3.0, "rechecks": 1})
    where, sizes = scenes if apart else scenes[0], [2, 2, 3]
    one_by_one, waves = (
        validated_batches(*pair, wish, sizes=sizes, scenes=where, join=join, run=ExecutionContext(threads=2))
        for join in (1, 2)
    )
    assert_same(waves, one_by_one)
    assert [one.shares for one in waves] == [one.shares for one in one_by_one]
    assert set(np.concatenate([one.grasps.scene for one in waves])) <= {0, 1}, "numbered as the batch has them"


@pytest.mark.parametrize("refused", [0, 1])
def test_a_batch_of_a_wave_without_a_place_has_no_grasps_but_for_the_first(pair, scenes, monkeypatch, refused) -> None:
    whole = together.synthesize_batches

    def narrow(hand: Any, obj: Any, asked: Sequence[BatchRequest], **named: Any) -> Any:
        made = whole(hand, obj, asked, **named)
        return [NoStartFound("no way in") if k == refused else grasps for k, grasps in enumerate(made)]

    monkeypatch.setattr(together, "synthesize_batches", narrow)
    wish = REQUEST.model_copy(update={"validation": "none", "want": "candidates"})
    asked: dict[str, Any] = {"sizes": [2, 2], "scenes": scenes[:2], "join": 2, "empty_on": (NoStartFound,)}
    with nullcontext() if refused else pytest.raises(NoStartFound, match="no way in"):
        made = validated_batches(*pair, wish, **asked, run=ExecutionContext(threads=2))
        assert [len(one.grasps) for one in made] == [2, 0]


def test_what_was_validated_before_a_stop_is_kept(pair, alone) -> None:
    stopped: list[bool] = []

    def one_is_made(number: int, made: ValidatedBatch) -> None:
        stopped.append(True)

    run = ExecutionContext(threads=2, cancelled=lambda: bool(stopped))
    found = validated_batches(*pair, REQUEST, sizes=[2, 32, 32], join=2, run=run, partial=True, checked=one_is_made)
    assert_same(found[:1], alone[:1])
    assert sum(len(one.grasps) for one in found) < 66


def test_what_becomes_of_one_batch_ends_the_job(pair) -> None:
    def torn(obj: object) -> object:
        raise MeshError("no pieces")

    with pytest.raises(MeshError, match="no pieces"):
        validated_batches(*pair, REQUEST, sizes=[2, 2], join=2, pieces=torn, run=ExecutionContext(threads=1))  # type: ignore[arg-type]


def test_how_many_are_joined_where_nobody_says() -> None:
    assert batches_at_once("cpu", None) == 1
    assert batches_at_once("cpu", 4) == 4
    # Of an H100 and an H200 (132 multiprocessors), of a GPU with 20, and of one whose memory is nearly full.
    assert [fitting(132, 80 << 30), fitting(20, 8 << 30), fitting(132, 1 << 30), fitting(132, 0)] == [32, 4, 4, 1]
