"""Large jobs enter the index in pieces: each turn is short, and others have theirs between two of them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import pytest
from sqlalchemy import func, select

from graspd.service.index.changes.records import RANGES_AT_ONCE
from graspd.service.index.rebuild import differences
from graspd.service.index.tables import tasks
from graspd.service.model import names
from graspd.service.model.errors import ConflictError
from graspd.service.model.states import State
from graspd.service.pipeline import job_actions
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.controller import Controller
from graspd.service.pipeline.deletion import delete_job
from tests.fakes import request

WorkOff = Callable[[], list[tuple[str, int]]]
LARGE = 32 * (2 * RANGES_AT_ONCE + 1)


def entered(services: Services) -> int:
    with services.index.database.reading() as connection:
        return int(connection.scalar(select(func.count()).select_from(tasks)) or 0)


@pytest.fixture
def now() -> list[float]:
    """The time that the controller reads."""
    return [0.0]


@pytest.fixture
def controller(services: Services, now: list[float]) -> Controller:
    """One that leads already: the index is whole."""
    made = Controller(services, clock=lambda: now[0])
    made.round()
    return made


@pytest.fixture
def work_off(services: Services, controller: Controller, now: list[float]) -> WorkOff:
    """Enters all that is left, and gives the job and the number of rows of each turn."""

    def enter() -> list[tuple[str, int]]:
        turns = []
        while services.index.write.entering():
            before = entered(services)
            now[0] += 10.0
            controller.round()
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


def test_a_job_is_told_whole_before_it_is_entered(services: Services) -> None:
    job, _ = job_actions.submit(services, request(grasps=LARGE))
    assert [(stage.tasks, stage.queued) for stage in job.stages] == [(LARGE // 32, LARGE // 32)]


def test_a_job_that_is_being_entered_has_not_ended(services: Services, work_off: WorkOff) -> None:
    job, _ = job_actions.submit(services, request(grasps=LARGE))
    assert not job_actions.cancel(services, job.id).state.is_final
    with pytest.raises(ConflictError):
        delete_job(services, job.id)
    work_off()
    assert services.index.jobs.get(job.id).state is State.CANCELLED
    assert differences(services.index, services.store) == []


def test_the_same_job_again_begins_nothing_anew(services: Services, work_off: WorkOff) -> None:
    job, _ = job_actions.submit(services, request(grasps=LARGE))
    work_off()
    again, new = job_actions.submit(services, request(grasps=LARGE))
    assert (again.id, new, services.index.write.entering()) == (job.id, False, [])


def test_a_job_whose_record_is_gone_is_given_up(services: Services, work_off: WorkOff) -> None:
    job, _ = job_actions.submit(services, request(grasps=LARGE))
    services.store.delete(names.job_record(job.id))
    assert work_off() == [(job.id, 0)]


@pytest.mark.slow
def test_five_jobs_of_a_million_grasps_delay_a_small_one_by_less_than_three_seconds(services: Services) -> None:
    stop, waits = threading.Event(), list[float]()
    leading = Controller(services)
    leading.round()
    controller = threading.Thread(target=leading.run, args=(stop,))
    controller.start()
    with ThreadPoolExecutor(5) as pool:
        large = [pool.submit(job_actions.submit, services, request(grasps=10**6, seed=seed)) for seed in range(5)]
        number = 0
        while not all(one.done() for one in large) or services.index.write.entering():
            number += 1
            start = time.monotonic()
            job_actions.submit(services, request(grasps=1, seed=100 + number))
            waits.append(time.monotonic() - start)
    stop.set()
    controller.join()
    print(f"{number} small jobs beside five large ones: longest wait {max(waits):.2f} s")
    assert entered(services) == 5 * 31_250 + number
    assert max(waits) < 3
