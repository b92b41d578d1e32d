"""Jobs whose grasps are planned in scenes: their stages, their end where nothing can be found, and their grasps."""

from __future__ import annotations

import pytest

from service.index.queries.grasps import GraspFilter, GraspSort
from service.model import names
from service.model.planning import plan
from service.model.records import JobRecord
from service.model.states import Stage, State
from service.pipeline import job_actions
from service.pipeline.backends import Services
from service.store.records import read_record
from tests.fakes import fail_task, make_task, record_of, request


def submit(services: Services, **changes: object) -> JobRecord:
    return record_of(services, job_actions.submit(services, request(**{"scene": "table", **changes}))[0].id)


def make(services: Services, job: JobRecord, stage: Stage, batch: int = 0) -> None:
    make_task(services, job, next(task for task in plan(job) if task.stage is stage and task.batch == batch))


def fail(services: Services, job: JobRecord, batch: int, kind: str, number: int = 1) -> None:
    """The last attempt at a batch's grasps."""
    task = next(task for task in plan(job) if task.stage is Stage.SYNTHESIZE and task.batch == batch)
    fail_task(services, job.id, task, number, kind=kind, reason="none of 128 grasps tried is valid in its scene")


def states(services: Services, job: JobRecord) -> dict[tuple[int, Stage], State]:
    return {(task.batch, task.stage): task.state for task in services.index.jobs.tasks(job=job.id).items}


def test_scenes_are_made_before_grasps_and_told_in_that_order(services: Services) -> None:
    job = submit(services, grasps=64, views=1)
    assert len(services.queue.waiting()) == 2, "the scenes of both batches"
    told = services.index.jobs.get(job.id).stages
    order = (Stage.SCENE, Stage.SYNTHESIZE, Stage.RENDER)
    assert [(stage.stage, stage.tasks) for stage in told] == [(stage, 2) for stage in order]
    make(services, job, Stage.SCENE)
    ready = [(task.task.batch, task.task.stage) for task in services.index.feed.ready_of_job(job.id, limit=9)]
    assert ready == [(0, Stage.SYNTHESIZE)], "the other batch's scenes are queued already"


@pytest.mark.parametrize("kind", ["SceneError", "LoadError"])
def test_a_job_ends_when_its_first_batch_finds_nothing_in_its_scenes(services: Services, kind: str) -> None:
    job = submit(services, grasps=128)
    for batch in range(2):
        make(services, job, Stage.SCENE, batch)
    make(services, job, Stage.SYNTHESIZE, 1)
    fail(services, job, 0, kind)
    ended = services.index.jobs.get(job.id)
    assert (ended.state, ended.reason) == (State.FAILED, "none of 128 grasps tried is valid in its scene")
    found = states(services, job)
    assert found[0, Stage.SYNTHESIZE] is State.FAILED
    assert found[1, Stage.SYNTHESIZE] is State.SUCCEEDED, "what is made stays"
    assert {found[batch, stage] for batch in (2, 3) for stage in (Stage.SCENE, Stage.SYNTHESIZE)} == {State.CANCELLED}
    assert services.index.feed.ready_of_job(job.id, limit=9) == []


def test_a_retry_takes_up_the_batches_that_were_not_made(services: Services) -> None:
    job = submit(services, grasps=64)
    make(services, job, Stage.SCENE)
    fail(services, job, 0, "SceneError")
    job_actions.retry(services, job.id)
    found = states(services, job)
    assert {found[0, Stage.SYNTHESIZE], found[1, Stage.SCENE], found[1, Stage.SYNTHESIZE]} == {State.QUEUED}
    fail(services, job, 0, "SceneError", number=2)
    assert states(services, job)[1, Stage.SCENE] is State.CANCELLED


@pytest.mark.parametrize(("batch", "kind"), [(1, "SceneError"), (0, "WorkerLost")])
def test_a_later_batch_or_another_fault_stops_no_other_batch(services: Services, batch: int, kind: str) -> None:
    job = submit(services, grasps=96)
    for one in range(2):
        make(services, job, Stage.SCENE, one)
    fail(services, job, batch, kind)
    found = states(services, job)
    assert found[batch, Stage.SYNTHESIZE] is State.FAILED
    assert found[1 - batch, Stage.SYNTHESIZE] is State.QUEUED
    assert found[2, Stage.SCENE] is State.QUEUED
    assert services.index.jobs.get(job.id).state is State.RUNNING


def test_grasps_are_found_by_their_scene_and_what_they_hold_there(services: Services) -> None:
    free = read_record(JobRecord, services.store, names.job_record(job_actions.submit(services, request())[0].id))
    make(services, free, Stage.SYNTHESIZE)
    table, inside = submit(services), submit(services, scene="bin", seed=1)
    for job in (table, inside):
        make(services, job, Stage.SCENE)
        make(services, job, Stage.SYNTHESIZE)

    def count(**where: object) -> int:
        return len(services.index.grasps.page(GraspFilter.model_validate(where), limit=200).items)

    assert [count(scene=kind) for kind in ("free", "table", "bin", "shelf", "any", None)] == [32, 32, 32, 0, 64, 96]
    held = count(scene="table", lift_hard=True)
    assert held == count(scene="table", valid=True) > 0
    assert count(lift_hard=True, scene="free") == 0
    far = services.index.grasps.page(
        GraspFilter(at_least={"clearance_m": 0.5}), sort=GraspSort(by="clearance_m"), limit=200
    ).items
    assert far and {grasp.scene_kind for grasp in far} == {"table", "bin"}
    assert far[0].clearance_m == max(grasp.clearance_m for grasp in far)
