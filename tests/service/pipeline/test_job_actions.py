"""Submit, cancel and retry."""

from __future__ import annotations

import pytest

from graspd.service.index.rebuild import differences
from graspd.service.model import names
from graspd.service.model.errors import ConflictError, InputError, NotFoundError, QueueUnavailable
from graspd.service.model.states import AssetKind, Priority, State
from graspd.service.pipeline import job_actions
from graspd.service.pipeline.backends import Services
from graspd.service.store.library import publish_asset
from graspd.service.store.records import job_events
from tests.fakes import HAND_FILES, request, with_settings
from tests.memory_queue import MemoryQueue
from tests.service.index.test_index import fail, run_all


def queue_of(services: Services) -> MemoryQueue:
    assert isinstance(services.queue, MemoryQueue)
    return services.queue


def test_a_submitted_job_is_in_store_index_and_queue(services: Services) -> None:
    job, new = job_actions.submit(services, request(grasps=64, scenes=1))
    assert new
    assert services.store.exists(names.job_record(job.id))
    assert [stage.tasks for stage in job.stages] == [2, 2]
    assert len(services.queue.waiting()) == 2, "only what may start"


def test_the_same_request_is_the_same_job(services: Services) -> None:
    first, _ = job_actions.submit(services, request())
    digest = services.index.assets.get(AssetKind.HAND, "gripper").digest
    for hand in ("gripper", digest):
        again, new = job_actions.submit(services, request(hand=hand))
        assert (again.id, again.created, new) == (first.id, first.created, False)
    assert len(services.queue.waiting()) == 1


def test_an_unknown_hand_or_object_leaves_nothing_behind(services: Services) -> None:
    for changes in ({"hand": "unknown"}, {"object": "unknown"}):
        with pytest.raises(NotFoundError, match="unknown"):
            job_actions.submit(services, request(**changes))
    assert list(services.store.list(names.JOBS)) == []


@pytest.mark.parametrize(
    ("check", "error", "why"),
    [
        ({"verdict": "refuse", "message": "it has no joints"}, InputError, "it has no joints"),
        (None, ConflictError, "still being checked"),
    ],
)
def test_a_hand_that_was_not_found_good_cannot_be_used(
    services: Services, check: dict[str, str] | None, error: type[Exception], why: str
) -> None:
    asset = publish_asset(services.store, AssetKind.HAND, "broken", HAND_FILES | {"extra": b"1"})
    services.index.write.add_asset(asset, check)
    with pytest.raises(error, match=why):
        job_actions.submit(services, request(hand="broken"))


def test_without_redis_nothing_is_recorded_of_a_submit(services: Services, monkeypatch: pytest.MonkeyPatch) -> None:
    def gone() -> float:
        raise QueueUnavailable("Redis does not answer")

    monkeypatch.setattr(services.queue, "ping", gone)
    with pytest.raises(QueueUnavailable):
        job_actions.submit(services, request())
    assert list(services.store.list(names.JOBS)) == []
    assert services.index.jobs.page().items == []


def test_a_large_job_fills_the_window_and_no_more(services: Services) -> None:
    job, _ = job_actions.submit(with_settings(services, queue_window=10), request(grasps=3200))
    assert len(services.queue.waiting()) == 10
    assert job.priority is Priority.BULK
    assert job.stages[0].tasks == 100


def test_a_cancelled_job_leaves_the_queue(services: Services) -> None:
    job, _ = job_actions.submit(services, request(grasps=64))
    queue_of(services).take("w")
    run_all(services, job.id, batches=1)
    after = job_actions.cancel(services, job.id)
    assert after.state is State.CANCELLED
    assert (after.stages[0].succeeded, after.stages[0].cancelled) == (1, 1)
    assert services.queue.waiting() == set()
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
    run_all(services, job.id)
    with pytest.raises(ConflictError, match="succeeded"):
        job_actions.cancel(services, job.id)


def test_a_retried_job_gets_fresh_attempts(services: Services) -> None:
    job, _ = job_actions.submit(services, request(grasps=64))
    run_all(services, job.id, batches=1)
    for number in (1, 2, 3):
        fail(services, job.id, 1, number, last=number == 3)
    failed = services.index.jobs.get(job.id)
    assert (failed.state, failed.reason) == (State.FAILED, "attempt 3 went wrong")
    queue = queue_of(services)
    while queue.take("w") is not None:
        pass
    after = job_actions.retry(services, job.id)
    assert (after.state, after.reason) == (State.RUNNING, None)
    delivery = queue.take("w")
    assert delivery is not None
    assert (delivery.message.attempt, delivery.message.max_attempt) == (4, 6)
    assert len(services.index.jobs.attempts(job=job.id)) == 3, "the history stays"
