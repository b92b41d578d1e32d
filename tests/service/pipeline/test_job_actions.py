"""Jobs of a user: submit, cancel and retry; those planned in scenes: what is refused, their stages, end and grasps."""

from typing import Any
from unittest.mock import Mock

import pytest

from graspd.service.index.queries.grasps import GraspFilter, GraspSort
from graspd.service.index.rebuild import differences
from graspd.service.index.views import AssetView
from graspd.service.model import names
from graspd.service.model.errors import ConflictError, NotFoundError, QueueUnavailable, SceneError
from graspd.service.model.planning import plan_tasks
from graspd.service.model.records import JobRecord
from graspd.service.model.states import AssetKind, Priority, Stage, State
from graspd.service.pipeline import job_actions
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.job_actions import check_scene
from graspd.service.store.library import load_asset
from graspd.service.store.records import job_events
from tests.fakes import fail_task, finish, make_task, record_of, request, with_settings
from tests.service.index.test_index import fail


def test_the_same_request_is_the_same_job(services: Services) -> None:
    first, _ = job_actions.submit(services, request())
    digest = services.index.assets.get(AssetKind.HAND, "gripper").digest
    for hand in ("gripper", digest):
        again, new = job_actions.submit(services, request(hand=hand))
        assert (again.id, again.created, new) == (first.id, first.created, False)
    assert len(services.queue.waiting_tasks()) == 1


def test_an_unknown_hand_or_a_lost_redis_leaves_nothing_behind(
    services: Services, monkeypatch: pytest.MonkeyPatch
) -> None:
    for changes in ({"hand": "unknown"}, {"object": "unknown"}):
        with pytest.raises(NotFoundError, match="unknown"):
            job_actions.submit(services, request(**changes))
    assert list(services.store.list(names.JOBS)) == []
    monkeypatch.setattr(services.queue, "ping", Mock(side_effect=QueueUnavailable("Redis does not answer")))
    with pytest.raises(QueueUnavailable):
        job_actions.submit(services, request())
    assert list(services.store.list(names.JOBS)) == []
    assert services.index.jobs.page().items == []


def test_a_large_job_fills_the_window_and_no_more(services: Services) -> None:
    job, _ = job_actions.submit(with_settings(services, queue_window=10), request(grasps=3200))
    assert len(services.queue.waiting_tasks()) == 10
    assert job.priority is Priority.BULK and job.stages[0].tasks == 100


def test_a_cancelled_job_leaves_the_queue(services: Services) -> None:
    job, _ = job_actions.submit(services, request(grasps=64))
    services.queue.take("w")
    finish(services, job.id, batches=1)
    after = job_actions.cancel(services, job.id)
    assert after.state is State.CANCELLED and (after.stages[0].succeeded, after.stages[0].cancelled) == (1, 1)
    assert services.queue.waiting_tasks() == set()
    assert [event.what for event in job_events(services.store, job.id)] == ["cancelled"]


def test_where_a_cancelled_task_ran_is_no_difference(services: Services) -> None:
    job, _ = job_actions.submit(services, request())
    with pytest.raises(ConflictError, match="queued"):
        job_actions.retry(services, job.id)
    services.index.live.set_running({task.id: "w" for task in services.index.jobs.tasks(job=job.id).items})
    job_actions.cancel(services, job.id)
    assert differences(services.index, services.store) == []


def test_a_finished_job_cannot_be_cancelled(services: Services) -> None:
    job, _ = job_actions.submit(services, request())
    finish(services, job.id)
    with pytest.raises(ConflictError, match="succeeded"):
        job_actions.cancel(services, job.id)


def test_a_retried_job_gets_fresh_attempts(services: Services) -> None:
    job, _ = job_actions.submit(services, request(grasps=64))
    finish(services, job.id, batches=1)
    for number in (1, 2, 3):
        fail(services, job.id, 1, number, last=number == 3)
    failed = services.index.jobs.get(job.id)
    assert (failed.state, failed.reason) == (State.FAILED, "attempt 3 went wrong")
    queue: Any = services.queue
    while queue.take("w") is not None:
        pass
    after = job_actions.retry(services, job.id)
    assert (after.state, after.reason) == (State.RUNNING, None)
    delivery = queue.take("w")
    assert delivery is not None and (delivery.message.attempt, delivery.message.max_attempt) == (4, 6)
    assert len(services.index.jobs.attempts(job=job.id)) == 3, "the history stays"


def submit(services: Services, **changes: object) -> JobRecord:
    return record_of(services, job_actions.submit(services, request(**{"scene": "table", **changes}))[0].id)


def make(services: Services, job: JobRecord, stage: Stage, batch: int = 0) -> None:
    make_task(services, job, next(task for task in plan_tasks(job) if task.stage is stage and task.batch == batch))


def fail_batch(services: Services, job: JobRecord, batch: int, kind: str, number: int = 1) -> None:
    task = next(task for task in plan_tasks(job) if task.stage is Stage.SYNTHESIZE and task.batch == batch)
    fail_task(services, job.id, task, number, kind=kind, reason="none of 128 candidates is valid in its scene")


def states(services: Services, job: JobRecord) -> dict[tuple[int, Stage], State]:
    return {(task.batch, task.stage): task.state for task in services.index.jobs.tasks(job=job.id).items}


def test_scenes_are_made_before_grasps_and_told_in_that_order(services: Services) -> None:
    job = submit(services, grasps=64, views=1)
    assert len(services.queue.waiting_tasks()) == 2, "the scenes of both batches"
    told = services.index.jobs.get(job.id).stages
    order = (Stage.SCENE, Stage.SYNTHESIZE, Stage.RENDER)
    assert [(stage.stage, stage.tasks) for stage in told] == [(stage, 2) for stage in order]
    make(services, job, Stage.SCENE)
    ready = [(task.task.batch, task.task.stage) for task in services.index.feed.ready_tasks_of_job(job.id, limit=9)]
    assert ready == [(0, Stage.SYNTHESIZE)], "the other batch's scenes are queued already"


@pytest.mark.parametrize("kind", ["SceneError", "LoadError"])
def test_a_job_ends_when_its_first_batch_finds_nothing(services: Services, kind: str) -> None:
    job = submit(services, grasps=128)
    for batch in range(2):
        make(services, job, Stage.SCENE, batch)
    make(services, job, Stage.SYNTHESIZE, 1)
    fail_batch(services, job, 0, kind)
    ended = services.index.jobs.get(job.id)
    assert (ended.state, ended.reason) == (State.FAILED, "none of 128 candidates is valid in its scene")
    found = states(services, job)
    assert found[0, Stage.SYNTHESIZE] is State.FAILED
    assert found[1, Stage.SYNTHESIZE] is State.SUCCEEDED, "what is made stays"
    assert {found[batch, stage] for batch in (2, 3) for stage in (Stage.SCENE, Stage.SYNTHESIZE)} == {State.CANCELLED}
    assert services.index.feed.ready_tasks_of_job(job.id, limit=9) == []


def test_a_retry_takes_up_the_batches_that_were_not_made(services: Services) -> None:
    job = submit(services, grasps=64)
    make(services, job, Stage.SCENE)
    fail_batch(services, job, 0, "SceneError")
    job_actions.retry(services, job.id)
    found = states(services, job)
    assert {found[0, Stage.SYNTHESIZE], found[1, Stage.SCENE], found[1, Stage.SYNTHESIZE]} == {State.QUEUED}
    fail_batch(services, job, 0, "SceneError", number=2)
    assert states(services, job)[1, Stage.SCENE] is State.CANCELLED


@pytest.mark.parametrize(("batch", "kind"), [(1, "SceneError"), (0, "WorkerLost")])
def test_a_later_batch_or_another_fault_stops_no_other_batch(services: Services, batch: int, kind: str) -> None:
    job = submit(services, grasps=96)
    for one in range(2):
        make(services, job, Stage.SCENE, one)
    fail_batch(services, job, batch, kind)
    found = states(services, job)
    assert found[batch, Stage.SYNTHESIZE] is State.FAILED and found[1 - batch, Stage.SYNTHESIZE] is State.QUEUED
    assert found[2, Stage.SCENE] is State.QUEUED
    assert services.index.jobs.get(job.id).state is State.RUNNING


def test_grasps_are_found_by_their_scene(services: Services) -> None:
    free = record_of(services, job_actions.submit(services, request())[0].id)
    make(services, free, Stage.SYNTHESIZE)
    table, inside = submit(services), submit(services, scene="bin", seed=1)
    for job in (table, inside):
        make(services, job, Stage.SCENE)
        make(services, job, Stage.SYNTHESIZE)

    def count(**where: object) -> int:
        return len(services.index.grasps.page(GraspFilter.model_validate(where), limit=200).items)

    assert [count(scene=kind) for kind in ("free", "table", "bin", "shelf", "any", None)] == [32, 32, 32, 0, 64, 96]
    assert count(scene="table", lift_hard=True) == count(scene="table", valid=True) > 0
    assert count(lift_hard=True, scene="free") == 0
    half = GraspFilter(at_least={"clearance_m": 0.5})
    far = services.index.grasps.page(half, sort=GraspSort(by="clearance_m"), limit=200).items
    assert far and {grasp.scene_kind for grasp in far} == {"table", "bin"}
    assert far[0].clearance_m == max(grasp.clearance_m for grasp in far)


UPRIGHT = [1.0, 0, 0, 0]
GROUND = {"kind": "half_space", "normal": [0, 0, 2], "offset": 0.2}
SLOPE = {"kind": "box", "size": [0.2, 0.2, 0.2], "pose": [0.5, 0, 0, 0.8, 0, 0.6, 0]}


def ball(centre: Any) -> AssetView:
    what = {"kind": AssetKind.OBJECT, "name": "ball", "digest": "b" * 32, "filename": "ball.stl", "files": []}
    found = {"verdict": "accept", "message": None, "repairs": [], "facts": {"centre_of_mass_m": centre}}
    return AssetView(**what, **found, size_bytes=1, created="", builtin=False)


@pytest.mark.parametrize(
    ("supports", "target", "said"),
    [
        # The plane lies at 0.2 / |normal| = 0.1 m, the centre at 0.03.
        ([GROUND], [0, 0, 0, *UPRIGHT], "support 0 of its scene: its centre is 70 mm inside"),
        ([GROUND], [0, 0, 0.0995, *UPRIGHT], None),
        # The box's middle is 20 mm from the centre, whichever way the box is turned.
        ([GROUND, SLOPE], [0.52, 0, 0.3, *UPRIGHT], None),
        ([SLOPE], [0.5, 0, -0.03, *UPRIGHT], "support 0 of its scene: its centre is 100 mm inside"),
        # Turned upside down about x the centre hangs below the frame.
        ([GROUND], [0, 0, 0.12, 0, 1, 0, 0], "support 0 of its scene: its centre is 10 mm inside"),
    ],
)
def test_a_target_whose_centre_lies_in_a_support_is_refused(supports: Any, target: Any, said: str | None) -> None:
    wanted = request(scene={"supports": supports, "target": target})
    if said is None:
        check_scene(wanted, ball([0, 0, 0.03]))
        return
    with pytest.raises(SceneError, match=said):
        check_scene(wanted, ball([0, 0, 0.03]))


def test_where_the_centre_is_not_known_a_worker_tells() -> None:
    check_scene(request(scene={"supports": [GROUND], "target": [0, 0, -1, *UPRIGHT]}), ball(None))


def test_a_refused_scene_leaves_no_job_behind(services: Services) -> None:
    asset = services.index.assets.get(AssetKind.OBJECT, "ball")
    facts = {"verdict": "accept", "facts": {"centre_of_mass_m": [0.0, 0.0, 0.0]}}
    services.index.write.add_asset(load_asset(services.store, AssetKind.OBJECT, asset.digest), facts)
    with pytest.raises(SceneError, match="ball penetrates support 0"):
        job_actions.submit(services, request(scene={"supports": [GROUND], "target": [0, 0, 0, *UPRIGHT]}))
    assert list(services.store.list(names.JOBS)) == []
