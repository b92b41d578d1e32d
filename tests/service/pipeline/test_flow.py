"""Many tasks through one controller: reports, events in bulk, stages between two sweeps, large jobs in pieces."""

import contextlib
from collections.abc import Callable
from dataclasses import replace

import pytest
from sqlalchemy import func, select

from graspd.service.index.changes.records import RANGES_AT_ONCE
from graspd.service.index.rebuild import differences
from graspd.service.index.tables import tasks
from graspd.service.model import names
from graspd.service.model.clock import timestamp
from graspd.service.model.errors import ConflictError
from graspd.service.model.messages import capabilities
from graspd.service.model.states import Priority, Stage, State
from graspd.service.pipeline import job_actions
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.controller import Controller, PeriodicDuty
from graspd.service.pipeline.deletion import delete_job
from graspd.service.queue.port import Event, EventKind
from tests.fakes import beat_of, make_shard, request, with_settings
from tests.memory_queue import Delivery
from tests.waiting import Clock


def taken(services: Services) -> list[Delivery]:
    held = []
    while (delivery := services.queue.take(f"w{len(held)}")) is not None:
        services.queue.publish(_event(delivery, EventKind.STARTED))
        held.append(delivery)
    return held


def finish(services: Services, delivery: Delivery) -> None:
    make_shard(services.store, delivery.message)  # type: ignore[arg-type]
    services.queue.finish(delivery)
    services.queue.publish(_event(delivery, EventKind.FINISHED))


def _event(delivery: Delivery, kind: EventKind) -> Event:
    message = delivery.message
    output = "" if kind is EventKind.STARTED else message.output  # type: ignore[union-attr]
    of = {"task_id": message.task_id, "stage": message.stage, "worker": delivery.worker, "output": output}
    return Event(kind=kind, at=timestamp(), **of)


@pytest.fixture
def controller(services: Services) -> Controller:
    made = Controller(services, clock=Clock())
    made.run_round()
    return made


def test_the_next_stage_is_queued_without_waiting_for_a_sweep(services: Services, controller: Controller) -> None:
    job_actions.submit(services, request(scenes=2))
    (first,) = taken(services)
    finish(services, first)
    controller.run_round()
    assert [delivery.message.stage for delivery in taken(services)] == [Stage.SCENE]


def test_what_runs_is_not_queued_and_many_ends_are_one_round(services: Services, controller: Controller) -> None:
    job, _ = job_actions.submit(services, request(grasps=32 * 40), priority=Priority.BULK)
    held = taken(services)
    finish(services, held[0])
    controller.run_round()
    assert services.queue.waiting_tasks() == set()
    for delivery in held[1:]:
        finish(services, delivery)
    controller.run_round()
    done = services.index.jobs.get(job.id)
    assert (done.state, done.grasps) == (State.SUCCEEDED, 32 * 40)


def test_progress_of_a_task_reaches_the_index_and_goes(services: Services, controller: Controller) -> None:
    job, _ = job_actions.submit(services, request())
    (held,) = taken(services)
    busy = replace(beat_of("w0"), task_id=held.message.task_id)
    services.queue._workers["w0"] = replace(busy, done=3.0, total=4.0, message="descending")
    controller._clock.now += 1.0
    controller.run_round()
    (task,) = services.index.jobs.tasks(job=job.id).items
    assert (task.done, task.total, task.message) == (3.0, 4.0, "descending")
    finish(services, held)  # and its worker has not said so yet
    services.queue._workers["w0"] = replace(busy, done=4.0, total=4.0, message="late")
    for _ in range(2):
        controller._clock.now += 1.0
        controller.run_round()
    (task,) = services.index.jobs.tasks(job=job.id).items
    assert task.state is State.SUCCEEDED and task.message != "late"


def test_a_fleet_larger_than_the_window_finds_work(services: Services) -> None:
    small = with_settings(services, queue_window=1)
    own = capabilities()
    can = {"stages": (Stage.SYNTHESIZE,), "schemas": own.schemas, "revisions": dict(own.revisions)}
    services.queue._workers.update({name: beat_of(name, **can) for name in map(str, range(20))})
    controller = Controller(small, clock=(clock := Clock()))
    controller.run_round()
    job_actions.submit(small, request(grasps=32 * 100), priority=Priority.BULK)
    clock.now += 1.0
    controller.run_round()
    assert len(services.queue.waiting_tasks()) == 40


@pytest.mark.parametrize(
    ("cost_s", "pause_s"), [(0.0, 1.0), (0.25, 1.0), (1.0, 4.0), (3.0, 6.0)], ids=["free", "cheap", "dear", "bounded"]
)
def test_the_pause_follows_from_the_cost(cost_s: float, pause_s: float) -> None:
    clock, done = Clock(), list[float]()

    def work() -> None:
        clock.now += cost_s
        done.append(clock.now)

    duty = PeriodicDuty(clock, work, 1.0, share=0.2, longest_s=6.0)
    duty()
    clock.now += pause_s - 0.01
    duty()
    assert len(done) == 1
    clock.now += 0.02
    duty()
    assert len(done) == 2


@pytest.mark.parametrize("work", [lambda: 1 / 0, lambda: True], ids=["broke off", "has more to do"])
def test_what_is_not_done_is_due_at_once(work: Callable[[], object]) -> None:
    begun: list[int] = []
    duty = PeriodicDuty(Clock(), lambda: begun.append(1) or work(), 1.0)  # type: ignore[func-returns-value]
    for _ in range(2):
        with contextlib.suppress(ZeroDivisionError):
            duty()
    assert len(begun) == 2


WorkOff = Callable[[], list[tuple[str, int]]]
LARGE = 32 * (2 * RANGES_AT_ONCE + 1)


def entered(services: Services) -> int:
    with services.index.database.read_transaction() as connection:
        return int(connection.scalar(select(func.count()).select_from(tasks)) or 0)


@pytest.fixture
def work_off(services: Services, controller: Controller) -> WorkOff:
    """Enters all that is left, and gives the job and the number of rows of each turn."""

    def enter() -> list[tuple[str, int]]:
        turns = []
        while services.index.write.partly_entered_jobs():
            before = entered(services)
            controller._clock.now += 10.0
            controller.run_round()
            turns.append((controller._entered, entered(services) - before))
        return turns

    return enter


def test_turns_are_short_and_alternate(services: Services, work_off: WorkOff) -> None:
    jobs = [job_actions.submit(services, request(grasps=LARGE, seed=seed))[0].id for seed in range(2)]
    assert entered(services) == 2 * RANGES_AT_ONCE
    turns = work_off()
    assert [job for job, _ in turns] == 2 * sorted(jobs)
    assert [rows for _, rows in turns] == [RANGES_AT_ONCE, RANGES_AT_ONCE, 1, 1]
    assert differences(services.index, services.store) == []


def test_a_job_is_told_whole_and_the_same_again_begins_nothing_anew(services: Services, work_off: WorkOff) -> None:
    job, _ = job_actions.submit(services, request(grasps=LARGE))
    assert [(stage.tasks, stage.queued) for stage in job.stages] == [(LARGE // 32, LARGE // 32)]
    work_off()
    again, new = job_actions.submit(services, request(grasps=LARGE))
    assert (again.id, new, services.index.write.partly_entered_jobs()) == (job.id, False, [])


def test_a_job_that_is_being_entered_has_not_ended(services: Services, work_off: WorkOff) -> None:
    job, _ = job_actions.submit(services, request(grasps=LARGE))
    assert not job_actions.cancel(services, job.id).state.is_final
    with pytest.raises(ConflictError):
        delete_job(services, job.id)
    work_off()
    assert services.index.jobs.get(job.id).state is State.CANCELLED
    assert differences(services.index, services.store) == []


def test_a_job_whose_record_is_gone_is_given_up(services: Services, work_off: WorkOff) -> None:
    job, _ = job_actions.submit(services, request(grasps=LARGE))
    services.store.delete(names.job_record_key(job.id))
    assert work_off() == [(job.id, 0)]
