"""Many tasks through one controller: reports, events in bulk, and stages that follow one another between two sweeps."""

from __future__ import annotations

from service.model.ability import own_ability
from service.model.clock import timestamp
from service.model.states import Lane, Stage, State
from service.model.worker_beat import WorkerBeat
from service.pipeline import job_actions
from service.pipeline.backends import Parts
from service.pipeline.controller import Controller
from service.queue.port import Event, EventKind, Report
from tests.fakes import make_shard, request
from tests.memory_queue import Delivery, MemoryQueue


class Clock:
    now = 1000.0

    def __call__(self) -> float:
        return self.now


def taken(parts: Parts) -> list[Delivery]:
    """Every waiting task, in workers' hands."""
    assert isinstance(parts.queue, MemoryQueue)
    held = []
    while (delivery := parts.queue.take(f"w{len(held)}")) is not None:
        parts.queue.publish(_event(delivery, EventKind.STARTED))
        held.append(delivery)
    return held


def finish(parts: Parts, delivery: Delivery) -> None:
    assert isinstance(parts.queue, MemoryQueue)
    make_shard(parts.store, delivery.message)  # type: ignore[arg-type]
    parts.queue.finish(delivery)
    parts.queue.publish(_event(delivery, EventKind.FINISHED))


def _event(delivery: Delivery, kind: EventKind) -> Event:
    message = delivery.message
    output = "" if kind is EventKind.STARTED else message.output  # type: ignore[union-attr]
    return Event(kind=kind, at=timestamp(), task_id=message.task_id, stage=message.stage, worker=delivery.worker,
                 output=output)  # fmt: skip


def test_the_next_stage_is_queued_without_waiting_for_a_sweep(parts: Parts) -> None:
    controller = Controller(parts, clock=Clock())
    controller.round()
    job_actions.submit(parts, request(scenes=2))
    (first,) = taken(parts)
    finish(parts, first)
    controller.round()
    assert [delivery.message.stage for delivery in taken(parts)] == [Stage.SCENE]


def test_a_task_that_runs_is_not_queued_again_between_two_sweeps(parts: Parts) -> None:
    controller = Controller(parts, clock=Clock())
    controller.round()
    job_actions.submit(parts, request(grasps=96), lane=Lane.BULK)
    held = taken(parts)
    finish(parts, held[0])
    controller.round()
    assert parts.queue.waiting() == set()


def test_many_ends_at_once_are_one_round(parts: Parts) -> None:
    controller = Controller(parts, clock=Clock())
    controller.round()
    job, _ = job_actions.submit(parts, request(grasps=32 * 150), lane=Lane.BULK)
    for delivery in taken(parts):
        finish(parts, delivery)
    controller.round()
    done = parts.index.jobs.get(job.id)
    assert (done.state, done.grasps) == (State.SUCCEEDED, 32 * 150)


def test_how_far_a_task_is_reaches_the_index_and_goes_with_its_worker(parts: Parts) -> None:
    clock = Clock()
    controller = Controller(parts, clock=clock)
    controller.round()
    job, _ = job_actions.submit(parts, request())
    (held,) = taken(parts)
    parts.queue.report(held.message.task_id, Report(attempt=1, done=3.0, total=4.0, message="descending"))
    clock.now += 1.0
    controller.round()
    (task,) = parts.index.jobs.tasks(job=job.id).items
    assert (task.done, task.total, task.message) == (3.0, 4.0, "descending")
    assert isinstance(parts.queue, MemoryQueue)
    parts.queue.finish(held)  # it was killed before it said anything more
    for _ in range(2):
        clock.now += 1.0
        controller.round()
    assert parts.queue.reports() == {}


def test_a_fleet_larger_than_the_window_finds_work(parts: Parts) -> None:
    small = Parts(parts.settings.model_copy(update={"queue_window": 1}), parts.store, parts.index, parts.queue)
    assert isinstance(parts.queue, MemoryQueue)
    now, own = timestamp(), own_ability()
    for name in map(str, range(20)):
        parts.queue._workers[name] = WorkerBeat(
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
    job_actions.submit(small, request(grasps=32 * 100), lane=Lane.BULK)
    clock.now += 1.0
    controller.round()
    assert len(parts.queue.waiting()) == 40
