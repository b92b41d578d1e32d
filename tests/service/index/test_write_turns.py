"""Several processes write one index at once, as for a moment where one controller follows another."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import pytest

from service.index.rebuild import differences
from service.model import names
from service.model.planning import message_of, plan
from service.model.records import JobRecord
from service.model.states import Lane, State
from service.pipeline import job_actions
from service.pipeline.backends import Services
from service.settings import Settings
from service.store.records import put_record
from service.store.store import open_store
from tests.fakes import add_assets, make_shard, request
from tests.indexes import empty_index
from tests.memory_queue import MemoryQueue
from tests.waiting import PATIENCE_S

CONTROLLERS = 4


@pytest.fixture
def processes(index_url: str, tmp_path: Path) -> Iterator[list[Services]]:
    """The same service as several processes have it."""
    with ExitStack() as stack:
        store = open_store("memory://")
        made = [
            Services(Settings(data_dir=tmp_path), store, empty_index(index_url), MemoryQueue())
            for _ in range(CONTROLLERS)
        ]
        for services in made:
            stack.callback(services.index.close)
        add_assets(made[0])
        yield made


def enter(services: Services, place: int, seed: int, *, batches: int = 1) -> JobRecord:
    """A job whose id begins with a digit."""
    record = job_actions.prepare(services, request(grasps=32 * batches, seed=seed), lane=Lane.BULK)
    record = record.model_copy(update={"id": f"{place:x}{seed:031x}"})
    put_record(services.store, names.job_record(record.id), record)
    services.index.write.add_job(record)
    return record


def test_controllers_that_index_at_once_leave_the_rows_that_follow_from_the_store(processes: list[Services]) -> None:
    """Each indexes two jobs of eight; each job wants what a job of another wants as well."""
    jobs = [enter(processes[0], 2 * place, place % 4, batches=2) for place in range(8)]
    messages = {job.id: [message_of(job, task, attempt=1, max_attempt=3) for task in plan(job)] for job in jobs}
    made = {message.output: make_shard(processes[0].store, message) for job in jobs[:4] for message in messages[job.id]}
    begun = threading.Barrier(CONTROLLERS)

    def keep(number: int) -> None:
        services = processes[number]
        tasks = [message for job in jobs[2 * number : 2 * number + 2] for message in messages[job.id]]
        tasks = tasks if number % 2 else tasks[::-1]
        begun.wait(PATIENCE_S)
        for first in range(0, len(tasks), 2):
            some = tasks[first : first + 2]
            services.index.live.set_queued([message.task_id for message in some])
            services.index.live.set_running({message.task_id: f"worker-{number}" for message in some})
            services.index.write.add_manifests([made[message.output] for message in some])

    with ThreadPoolExecutor(CONTROLLERS) as pool:
        for done in [pool.submit(keep, number) for number in range(CONTROLLERS)]:
            done.result(PATIENCE_S)
    assert {processes[0].index.jobs.get(job.id).state for job in jobs} == {State.SUCCEEDED}
    assert differences(processes[0].index, processes[0].store) == []
    ends = processes[0].index.outbox.ends(0, limit=99)
    assert sorted(end.subject for end in ends) == sorted(job.id for job in jobs), "each is told once"
    assert len({end.seq for end in ends}) == len(jobs)
