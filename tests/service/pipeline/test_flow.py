"""Many tasks through one controller: reports, events in bulk, and stages that follow one another between two sweeps."""

from __future__ import annotations

import pytest

from service.model.clock import timestamp
from service.model.states import Lane, Stage, State
from service.model.workers import own_ability
from service.pipeline import job_actions
from service.pipeline.backends import Services
from service.pipeline.controller import Controller
from service.queue.port import Event, EventKind, Report
from tests.fakes import beat_of, make_shard, request, with_settings
from tests.memory_queue import Delivery, MemoryQueue
from tests.waiting import Clock


def taken(services: Services) -> list[Delivery]:
    """Every waiting task, in workers' hands."""
    assert isinstance(services.queue, MemoryQueue)
    held = []
    while (delivery := services.queue.take(f"w{len(held)}")) is not None:
        services.queue.publish(_event(delivery, EventKind.STARTED))
        held.append(delivery)
    return held


def finish(services: Services, delivery: Delivery) -> None:
    assert isinstance(services.queue, MemoryQueue)
    make_shard(services.store, delivery.message)  # type: ignore[arg-type]
    services.queue.finish(delivery)
    services.queue.publish(_event(delivery, EventKind.FINISHED))


def _event(delivery: Delivery, kind: EventKind) -> Event:
    message = delivery.message
    output = "" if kind is EventKind.STARTED else message.output  # type: ignore[union-attr]
    return Event(
        kind=kind, at=timestamp(), task_id=message.task_id, stage=message.stage, worker=delivery.worker, output=output
    )


@pytest.fixture
def controller(services: Services) -> Controller:
    """One that leads, to whom time passes by its clock alone."""
    made = Controller(services, clock=Clock())
    made.round()
    return made


def test_the_next_stage_is_queued_without_waiting_for_a_sweep(services: Services, controller: Controller) -> None:
    job_actions.submit(services, request(scenes=2))
    (first,) = taken(services)
    finish(services, first)
    controller.round()
    assert [delivery.message.stage for delivery in taken(services)] == [Stage.SCENE]


def test_what_runs_is_not_queued_again_and_many_ends_are_one_round(services: Services, controller: Controller) -> None:
    job, _ = job_actions.submit(services, request(grasps=32 * 150), lane=Lane.BULK)
    held = taken(services)
    finish(services, held[0])
    controller.round()
    assert services.queue.waiting() == set()
    for delivery in held[1:]:
        finish(services, delivery)
    controller.round()
    done = services.index.jobs.get(job.id)
    assert (done.state, done.grasps) == (State.SUCCEEDED, 32 * 150)


def test_how_far_a_task_is_reaches_the_index_and_goes_with_its_worker(
    services: Services, controller: Controller
) -> None:
    job, _ = job_actions.submit(services, request())
    (held,) = taken(services)
    services.queue.report(held.message.task_id, Report(attempt=1, done=3.0, total=4.0, message="descending"))
    controller._clock.now += 1.0
    controller.round()
    (task,) = services.index.jobs.tasks(job=job.id).items
    assert (task.done, task.total, task.message) == (3.0, 4.0, "descending")
    assert isinstance(services.queue, MemoryQueue)
    services.queue.finish(held)  # it was killed before it said anything more
    for _ in range(2):
        controller._clock.now += 1.0
        controller.round()
    assert services.queue.reports() == {}


def test_a_fleet_larger_than_the_window_finds_work(services: Services) -> None:
    small = with_settings(services, queue_window=1)
    assert isinstance(services.queue, MemoryQueue)
    own = own_ability()
    can = {"stages": (Stage.SYNTHESIZE,), "schemas": own.schemas, "revisions": dict(own.revisions)}
    services.queue._workers.update({name: beat_of(name, **can) for name in map(str, range(20))})
    controller = Controller(small, clock=(clock := Clock()))
    controller.round()
    job_actions.submit(small, request(grasps=32 * 100), lane=Lane.BULK)
    clock.now += 1.0
    controller.round()
    assert len(services.queue.waiting()) == 40
