"""Several keepers: one works, or all share the work; where one is killed or stands still the others go on."""

from __future__ import annotations

import signal
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

from service.index.rebuild import differences
from service.model.keeper_shards import shard_of
from service.model.states import State
from service.pipeline import job_actions
from tests.fakes import request
from tests.system.house import House


@pytest.fixture
def house(tmp_path: Path) -> Iterator[House]:
    made = House(tmp_path)
    yield made
    made.close()


@pytest.mark.chaos
def test_a_keeper_that_is_killed_or_stands_still_gives_way_and_nothing_is_lost(house: House) -> None:
    house.keeper("first")
    house.until(lambda: house.says("first", "this keeper leads"), "the first leads")
    house.keeper("second")
    house.until(lambda: house.says("second", "another keeper leads"), "the second waits")
    early = job_actions.submit(house.parts, request(seed=1))[0].id
    house.start("worker", sys.executable, "-m", "tests.fakes", FAKE_SECONDS="0.2")
    house.until(lambda: house.done(early) == 1, "the first keeps")

    house.hold.touch()
    job = job_actions.submit(house.parts, request(grasps=32 * 24))[0].id
    house.until(lambda: house.parts.index.jobs.tasks(job=job, state=State.RUNNING).items, "the worker has a task")
    house.processes["first"].kill()
    house.processes["first"].wait()
    house.until(lambda: house.says("second", "this keeper leads"), "the second takes over")
    assert house.done(job) == 0
    house.hold.unlink()
    house.until(lambda: house.done(job) >= 2, "the second keeps")

    house.hold.touch()
    house.keeper("third")
    house.until(lambda: house.says("third", "another keeper leads"), "the third waits")
    house.processes["second"].send_signal(signal.SIGSTOP)
    house.until(lambda: house.says("third", "this keeper leads"), "the third takes over")
    house.processes["second"].send_signal(signal.SIGCONT)
    house.until(lambda: house.says("second", "another leads now"), "the second notices")
    house.hold.unlink()

    house.until(lambda: house.parts.index.jobs.get(job).state.is_final, "the job is done")
    tasks = house.parts.index.jobs.tasks(job=job, limit=100).items
    assert {task.state for task in tasks} == {State.SUCCEEDED}
    assert [task.attempt for task in tasks] == [1] * 24, "no task was taken from its worker"
    assert house.says("worker", "synthesize took") == 1 + 24, "none was done twice"

    # A keeper that ends in order gives its lease back: the next one need not wait for it to run out.
    house.processes["third"].terminate()
    assert house.processes["third"].wait(60) == 0
    house.until(lambda: house.says("second", "this keeper leads") == 2, "the second leads again")


@pytest.mark.slow
@pytest.mark.chaos
def test_one_that_is_started_again_under_its_name_need_not_wait(house: House) -> None:
    house.keeper("first", GRASPD_KEEPER_NAME="node-1", GRASPD_LEASE_S="600")
    house.until(lambda: house.says("first", "this keeper leads"), "the first leads")
    house.processes["first"].kill()
    house.processes["first"].wait()
    house.keeper("again", GRASPD_KEEPER_NAME="node-1", GRASPD_LEASE_S="600")
    house.until(lambda: house.says("again", "this keeper leads"), "it leads again")


@pytest.mark.slow
@pytest.mark.chaos
def test_keepers_share_the_work_and_take_over_from_one_that_is_killed(tmp_path: Path) -> None:
    # No worker is killed here: on a busy machine one may be silent for some time and is there all the same.
    house = House(tmp_path, lease_s=8.0)

    def shares() -> list[int]:
        """How many of the shards each of the keepers holds, the least first."""
        holders = Counter(one.holder for one in house.parts.queue.keepers("keeper") if one.works)
        return sorted(holders.values())

    def tasks_that_are(state: State) -> int:
        return house.parts.index.overview.stats().tasks.get(state, 0)

    try:
        for name in "ab":
            house.keeper(name, GRASPD_KEEPER_SHARDS="4", GRASPD_KEEPER_NAME=name)
        house.until(lambda: shares() == [2, 2], "two share four shards evenly")
        early = job_actions.submit(house.parts, request(seed=99))[0].id
        house.start("worker", sys.executable, "-m", "tests.fakes", FAKE_SECONDS="0.05")
        house.until(lambda: house.done(early), "they keep")

        house.hold.touch()
        jobs = [job_actions.submit(house.parts, request(grasps=32 * 3, seed=seed))[0].id for seed in range(8)]
        assert len({shard_of(job, 4) for job in jobs}) > 1, "they are shared out"
        house.until(lambda: tasks_that_are(State.RUNNING), "the worker has a task")
        # The one that also has what is of no job.
        first = house.parts.queue.keepers("keeper")[0].holder
        house.processes[first].kill()
        house.processes[first].wait()
        house.until(lambda: shares() == [4], "the other has all shards")
        house.hold.unlink()

        house.until(lambda: tasks_that_are(State.SUCCEEDED) == 25, "all are done")
        tasks = [task for job in jobs for task in house.parts.index.jobs.tasks(job=job, limit=100).items]
        assert [task.attempt for task in tasks] == [1] * 24, "no task was taken from its worker"
        assert house.says("worker", "synthesize took") == 25, "none was done twice"
        assert differences(house.parts.index, house.parts.store) == []
    finally:
        house.close()
