"""How many batches a task has: by what was measured, by who is there, and never more than a fair share."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from graspd.service.index.changes.records import Changes
from graspd.service.index.rebuild import differences
from graspd.service.model.planning import message_of, plan
from graspd.service.model.records import JobRecord
from graspd.service.model.states import AssetKind, Priority, Stage, State
from graspd.service.model.version import SCHEMA_OF_RANGES, STAGE_REVISIONS, TASK_SCHEMA
from graspd.service.model.workers import WorkerBeat
from graspd.service.pipeline import job_actions
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.datasets import actions
from graspd.service.pipeline.datasets.spec import DatasetRequest
from graspd.service.pipeline.ranges import TaskRanges, span_of
from graspd.service.settings import Settings
from graspd.service.store.library import publish_asset
from graspd.service.store.manifests import ShardManifest, publish_shard
from graspd.worker.stages.context import TaskContext, shard_of
from tests.fakes import OBJECT_FILES, beat_of, fake_stages, request, with_settings
from tests.planning import plan_all
from tests.service.pipeline.test_controller import Bench


@pytest.fixture
def services(services: Services) -> Services:
    """A service whose tasks last half a minute."""
    return with_settings(services, task_s=30.0)


def worker(name: str = "w", *, device: str = "cpu", schemas: tuple[int, int] = (2, TASK_SCHEMA)) -> WorkerBeat:
    return beat_of(name, device=device, schemas=schemas, revisions=dict(STAGE_REVISIONS))


def here(services: Services, *workers: WorkerBeat) -> None:
    services.queue._workers = {one.name: one for one in workers}  # type: ignore[attr-defined]


def measured(services: Services, seconds: float) -> None:
    """A batch took so long."""
    job, _ = job_actions.submit(services, request(seed=99))
    (task,) = plan(record := JobRecord.model_validate_json(services.store.get(f"jobs/{job.id}/job.json")))
    message = message_of(record, task, attempt=1, max_attempt=1)
    made = fake_stages()[Stage.SYNTHESIZE](message, TaskContext(services.store))
    manifest, data = shard_of(message, made, device="cpu", seconds=seconds, worker="w")
    publish_shard(services.store, manifest, data)
    services.index.write.add_manifests([manifest])


def span(services: Services, grasps: int, priority: Priority = Priority.BULK, **changes: object) -> int:
    return job_actions.prepare(services, request(grasps=grasps, **changes), priority=priority).span


@given(st.integers(1, 40_000), st.integers(0, 5000), st.integers(0, 300))
def test_tasks_are_of_one_length_and_shared_evenly(batches: int, by_time: int, workers: int) -> None:
    found = span_of(batches, by_time, workers)
    assert 1 <= found <= max(1, min(64, by_time))
    tasks = math.ceil(batches / found)
    assert found * tasks - batches < tasks, "all but the last are full, and it lacks less than one batch a task"
    if workers:
        assert found <= math.ceil(batches / workers), "no worker waits while another has two"


def test_a_task_of_a_larger_job_lasts_as_the_settings_say(services: Services) -> None:
    here(services, worker())
    assert span(services, 32 * 100) == 4, "nothing was measured: a stored rate on two cores, 7 s a batch"
    # Half of what the fakes make is valid, so that a job of so many valid ones takes twice the candidates of a batch.
    measured(services, 0.5)
    assert 20 <= span(services, 32 * 1000) <= 40
    measured(services, 60.0)
    assert span(services, 32 * 1000) == 1


def test_a_job_of_ten_thousand_grasps_makes_few_objects(services: Services) -> None:
    here(services, worker())

    def objects(services: Services) -> int:
        return 2 * len(list(plan(job_actions.prepare(services, request(grasps=10_000), priority=Priority.BULK))))

    assert objects(replace(services, settings=Settings(data_dir=services.settings.data_dir))) == 80, "on two cores"
    measured(services, 0.1)
    assert objects(services) <= 12
    assert objects(with_settings(services, task_s=0.0)) == 626


def test_workers_share_a_job_fairly(services: Services) -> None:
    measured(services, 0.01)
    here(services, *(worker(f"w{number}") for number in range(4)))
    assert span(services, 32 * 16) == 4
    here(services, worker("a"), worker("b"))
    assert span(services, 32 * 16) == 8
    here(services)
    assert span(services, 32 * 16) == 2, "a fleet may start once tasks wait"


@pytest.mark.parametrize(("cells", "tasks"), [(1, 4), (2, 2), (8, 1)])
def test_cells_of_a_dataset_share_the_workers(services: Services, cells: int, tasks: int) -> None:
    measured(services, 0.01)
    here(services, *(worker(f"w{number}") for number in range(4)))
    for number in range(1, cells):
        asset = publish_asset(services.store, AssetKind.OBJECT, f"ball{number}", {**OBJECT_FILES, "n": bytes([number])})
        services.index.write.add_asset(asset, {"verdict": "accept", "message": "fine"})
    objects = ("ball", *(f"ball{number}" for number in range(1, cells)))
    actions.create(services, DatasetRequest(name="d", hands=("gripper",), objects=objects, grasps=32 * 16))
    assert services.index.datasets.get("d").tasks == 16 * cells, (
        "what it would be with a batch a task, until it is known"
    )
    plan_all(services)
    dataset = services.index.datasets.get("d")
    assert dataset.tasks == tasks * cells
    assert {cell.tasks for cell in services.index.datasets.cells("d").items} == {tasks}


def test_a_small_job_goes_batch_by_batch_but_on_a_gpu(services: Services) -> None:
    measured(services, 0.01)
    here(services, worker())
    assert span(services, 128, Priority.INTERACTIVE) == 1
    here(services, worker(device="cuda:0"))
    assert span(services, 128, Priority.INTERACTIVE) == 4
    here(services, worker("a", device="cuda:0"), worker("b"))
    assert span(services, 128, Priority.INTERACTIVE) == 1


def test_pictures_and_older_workers_keep_one_batch_a_task(services: Services) -> None:
    measured(services, 0.01)
    here(services, worker())
    assert span(services, 3200, scenes=1, views=1) == 1
    assert span(services, 3200, scenes=1) > 1
    here(services, worker("new"), worker("old", schemas=(2, SCHEMA_OF_RANGES - 1)))
    assert span(services, 3200) == 1
    known = job_actions.prepare(services, request(grasps=3200, scenes=1, views=1))
    with pytest.raises(ValidationError, match="pictures"):
        JobRecord.model_validate({**known.model_dump(mode="json"), "span": 2})


def test_rates_and_workers_are_read_once_for_many_jobs(services: Services) -> None:
    here(services, worker())
    now = 0.0
    ranges = TaskRanges(services, clock=lambda: now)
    job = job_actions.prepare(with_settings(services, task_s=0.0), request(grasps=3200), priority=Priority.BULK)
    assert ranges.sized(job).span == 4
    measured(services, 0.01)
    assert ranges.sized(job).span == 4
    now = 60.0
    assert ranges.sized(job).span > 4


def test_a_job_of_ranges_goes_through_its_stages(services: Services) -> None:
    bench = Bench(services)
    bench.controller.round()
    here(services, worker())
    job = job_actions.prepare(services, request(grasps=32 * 6 + 5, scenes=2), priority=Priority.BULK)
    assert job.span == 4
    job_actions.enter(services, job)
    bench.work_off()
    done = services.index.jobs.get(job.id)
    assert (done.state, done.grasps) == (State.SUCCEEDED, 197)
    assert [stage.tasks for stage in done.stages] == [2, 2]
    shards = services.index.shards.page(job=job.id).items
    assert {(shard.stage, shard.batch) for shard in shards} == {
        (s, b) for s in (Stage.SYNTHESIZE, Stage.SCENE) for b in (0, 4)
    }
    assert differences(services.index, services.store) == []


def test_shards_of_many_batches_enter_the_index_in_short_turns(
    services: Services, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = Bench(services)
    bench.controller.round()
    record = job_actions.prepare(services, request(grasps=32 * 64 * 5), priority=Priority.BULK)
    job, _ = job_actions.enter(services, record.model_copy(update={"span": 64}))
    turns: list[int] = []
    add = Changes.add_manifests

    def counted(self: Changes, manifests: list[ShardManifest], **options: Any) -> dict[str, State]:
        turns.append(sum(manifest.batches for manifest in manifests))
        return add(self, manifests, **options)

    monkeypatch.setattr(Changes, "add_manifests", counted)
    while (delivery := bench.queue.take("w")) is not None:
        bench.do(delivery)
    bench.pass_time(1)
    assert services.index.jobs.get(job.id).state is State.SUCCEEDED
    assert turns == [256, 64]
