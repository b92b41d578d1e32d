"""A task of several batches makes what tasks of one batch would, bit for bit, in one shard."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from graspd.service.model.errors import DamagedShard, TaskCancelled
from graspd.service.model.planning import message_of, plan
from graspd.service.model.records import JobRecord
from graspd.service.model.states import Stage
from graspd.service.queue.port import EventKind
from graspd.service.store.manifests import load_manifest, load_shard
from graspd.service.store.shards import Shard
from graspd.service.store.store import Store, open_store
from graspd.worker import generation
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.planners import NoStartFound
from graspd.worker.stages import synthesize
from graspd.worker.stages.context import StopReason, TaskContext
from graspd.worker.stages.ranges import base_rows, batches_of
from tests.fakes import message_for
from tests.worker.stages.jobs import end_of, job_of

SIZE = 3  # batches as small as they can be, so that several take a few seconds


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("graspd.service.model.domain", "graspd.service.model.planning", "graspd.worker.stages.ranges"):
        monkeypatch.setattr(f"{module}.BATCH_SIZE", SIZE)


def made(store: Store, span: int, **request: Any) -> tuple[JobRecord, list[tuple[Stage, Shard, Any]]]:
    """What a job makes whose tasks have so many batches: stage, shard and manifest of each task."""
    job = job_of(store, span, fidelity="draft", seed=3, **request)
    end = end_of(store, job)
    assert end.kind is EventKind.FINISHED, end
    tasks = [(task.stage, task.output) for task in plan(job)]
    return job, [(stage, load_shard(store, stage, out), load_manifest(store, stage, out)) for stage, out in tasks]


@pytest.mark.parametrize(
    "request_of",
    [{"scenes": 2}, {"rechecks": SIZE}, {"scene": "table", "scenes": 2, "budget": 20}],
    ids=["scenes after", "rechecks of the first batch", "scenes before"],
)
def test_a_range_is_its_batches_one_after_the_other(request_of: dict[str, Any]) -> None:
    apart = made(open_store("memory://"), 1, grasps=2 * SIZE + 1, **request_of)[1]
    _, together = made(open_store("memory://"), 3, grasps=2 * SIZE + 1, **request_of)
    assert len(apart) == 3 * len(together) > 0
    for stage, whole, manifest in together:
        parts = [shard for of, shard, _ in apart if of is stage]
        of_parts = [one for of, _, one in apart if of is stage]
        scenes = np.cumsum([0, *(len(part.arrays.get("scene/object_pose", ())) for part in parts)])
        bases = np.cumsum([0, *(len(shard["grasp/hand_pose"]) for of, shard, _ in apart if of is Stage.SYNTHESIZE)])
        assert whole.arrays.keys() == {path for part in parts for path in part.arrays}
        for path, column in whole.arrays.items():
            if path == "quality/thresholds_m":
                np.testing.assert_array_equal(column, parts[0][path])
                continue
            # Only some batches are rechecked.
            pieces = [part.arrays.get(path, np.full(len(part["grasp/hand_pose"]), -1)) for part in parts]
            if (firsts := {"grasp/scene_index": scenes, "grasp/base_index": bases}.get(path)) is not None:
                pieces = [piece + first for piece, first in zip(pieces, firsts, strict=False)]
            np.testing.assert_array_equal(column, np.concatenate(pieces), err_msg=path)
        assert manifest.batches == 3
        assert manifest.valid == sum(one.valid for one in of_parts)
        assert manifest.candidates == sum(one.candidates for one in of_parts)
        assert manifest.rechecked == sum(one.rechecked for one in of_parts)
        if stage is Stage.SYNTHESIZE:
            assert whole.attributes["batch_rows"] == str([one.count for one in of_parts])
            assert manifest.info["planned"] == sum(one.info["planned"] for one in of_parts)
            assert manifest.grasps == sum((one.grasps for one in of_parts), ())


def test_a_base_shard_of_other_batches_is_refused() -> None:
    base = Shard("base", {"batch_rows": f"[{SIZE}, {SIZE}]"}, {"grasp/hand_pose": np.zeros((2 * SIZE, 7))})
    message = message_for(Stage.SCENE, scenes=1).model_copy(update={"count": 2 * SIZE})
    assert base_rows(base, message) == [range(SIZE), range(SIZE, 2 * SIZE)]
    assert [(one.batch, one.count) for one in batches_of(message)] == [(0, SIZE), (1, SIZE)]
    with pytest.raises(DamagedShard, match="2 batches"):
        base_rows(base, message.model_copy(update={"count": 3 * SIZE}))


def test_range_tells_how_far_it_is_and_stops_where_it_is_told_to(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("graspd.worker.stages.context.REPORT_EVERY_S", 0.0)
    store = open_store("memory://")
    job, _ = made(store, 2, grasps=2 * SIZE, want="candidates")
    message = message_of(job, next(plan(job)), attempt=1, max_attempt=1)
    told: list[float] = []

    def tell(done: float, total: float, _: str) -> None:
        told.append(done / total)
        if len(told) == stops_at:
            context.stop(StopReason.CANCELLED)

    for stops_at in (0, 1):
        told.clear()
        context = TaskContext(store, ExecutionContext(threads=2), tell=tell)
        if stops_at:
            with pytest.raises(TaskCancelled):
                synthesize.run(message, context)
            assert told[-1] < 0.5, "it ends in its first batch"
        else:
            synthesize.run(message, context)
            assert told == sorted(told)
            assert any(0 < share < 0.5 for share in told) and any(0.5 < share < 1 for share in told)


@pytest.mark.parametrize(("refused", "rows"), [({1}, f"[{SIZE}, 0, 1]"), ({0}, "")])
def test_a_batch_without_a_place_has_no_grasps_but_for_the_first(
    monkeypatch: pytest.MonkeyPatch, refused: set[int], rows: str
) -> None:
    """As where none is found within the budget: the grasps of the other batches stay."""
    whole = generation.validated_grasps

    def some(*given: Any, batch: int, **options: Any) -> Any:
        if batch in refused:
            raise NoStartFound("no hand finds a way in")
        return whole(*given, batch=batch, **options)

    monkeypatch.setattr("graspd.worker.together.validated_grasps", some)
    asked = {"grasps": 2 * SIZE + 1, "scene": "table", "scenes": 2, "budget": 20}
    if not rows:
        with pytest.raises(AssertionError, match="no hand finds a way in"):
            made(open_store("memory://"), 3, **asked)
        return
    _, (_, (_, base, manifest)) = made(open_store("memory://"), 3, **asked)
    assert base.attributes["batch_rows"] == rows
    assert set(base["grasp/scene_index"]) <= {0, 1, 4, 5}, "the scenes of the batch are there, and empty"
    assert len(base["scene/object_pose"]) == 6
    assert manifest.count == SIZE + 1
