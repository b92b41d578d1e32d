"""Many tasks through one controller: reports, events in bulk, and stages that follow one another between two sweeps."""

from __future__ import annotations

from dataclasses import replace

from graspd.service.model.clock import timestamp
from graspd.service.model.states import Priority, Stage, State
from graspd.service.model.workers import WorkerBeat, own_ability
from graspd.service.pipeline import job_actions
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.controller import Controller
from graspd.service.queue.port import Event, EventKind
from tests.fakes import make_shard, request
from tests.memory_queue import Delivery, MemoryQueue


class Clock:
    now = 1000.0

    def __call__(self) -> float:
        return self.now


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


def test_the_next_stage_is_queued_without_waiting_for_a_sweep(services: Services) -> None:
    controller = Controller(services, clock=Clock())
    controller.round()
    job_actions.submit(services, request(scenes=2))
    (first,) = taken(services)
    finish(services, first)
    controller.round()
    assert [delivery.message.stage for delivery in taken(services)] == [Stage.SCENE]


def test_a_task_that_runs_is_not_queued_again_between_two_sweeps(services: Services) -> None:
    controller = Controller(services, clock=Clock())
    controller.round()
    job_actions.submit(services, request(grasps=96), priority=Priority.BULK)
    held = taken(services)
    finish(services, held[0])
    controller.round()
    assert services.queue.waiting() == set()


def test_many_ends_at_once_are_one_round(services: Services) -> None:
    controller = Controller(services, clock=Clock())
    controller.round()
    job, _ = job_actions.submit(services, request(grasps=32 * 150), priority=Priority.BULK)
    for delivery in taken(services):
        finish(services, delivery)
    controller.round()
    done = services.index.jobs.get(job.id)
    assert (done.state, done.grasps) == (State.SUCCEEDED, 32 * 150)


def test_how_far_a_task_is_reaches_the_index_until_it_ends(services: Services) -> None:
    clock = Clock()
    controller = Controller(services, clock=clock)
    controller.round()
    job, _ = job_actions.submit(services, request())
    (held,) = taken(services)
    assert isinstance(services.queue, MemoryQueue)
    busy = replace(WorkerBeat.of_this_process("w0", "cpu", Stage), task_id=held.message.task_id)
    services.queue._workers["w0"] = replace(busy, done=3.0, total=4.0, message="descending")
    clock.now += 1.0
    controller.round()
    (task,) = services.index.jobs.tasks(job=job.id).items
    assert (task.done, task.total, task.message) == (3.0, 4.0, "descending")
    finish(services, held)  # and its worker has not said so yet
    services.queue._workers["w0"] = replace(busy, done=4.0, total=4.0, message="late")
    for _ in range(2):
        clock.now += 1.0
        controller.round()
    (task,) = services.index.jobs.tasks(job=job.id).items
    assert task.state is State.SUCCEEDED and task.message != "late"


def test_a_fleet_larger_than_the_window_finds_work(services: Services) -> None:
    small = Services(
        services.settings.model_copy(update={"queue_window": 1}), services.store, services.index, services.queue
    )
    assert isinstance(services.queue, MemoryQueue)
    now, own = timestamp(), own_ability()
    for name in map(str, range(20)):
        services.queue._workers[name] = WorkerBeat(
            name,
            "h",
            1,
            "cpu",
            "",
            (Stage.SYNTHESIZE,),
            "0",
            "idle",
            "",
            now,
            now,
            "",
            own.schemas,
            dict(own.revisions),
        )
    clock = Clock()
    controller = Controller(small, clock=clock)
    controller.round()
    job_actions.submit(small, request(grasps=32 * 100), priority=Priority.BULK)
    clock.now += 1.0
    controller.round()
    assert len(services.queue.waiting()) == 40
