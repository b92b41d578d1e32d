"""Several controllers, of which one leads."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from graspd.service.index.rebuild import differences
from graspd.service.model.states import State
from graspd.service.pipeline import job_actions
from tests.fakes import request
from tests.system.house import House


@pytest.fixture
def house(tmp_path: Path) -> Iterator[House]:
    made = House(tmp_path)
    yield made
    made.close()


@pytest.mark.chaos
def test_a_controller_killed_or_stopped_gives_way(house: House) -> None:
    house.controller("first")
    house.until(lambda: house.says("first", "this controller leads"), "the first leads")
    house.controller("second")
    house.until(lambda: house.says("second", "another controller leads"), "the second waits")
    early = job_actions.submit(house.services, request(seed=1))[0].id
    house.start("worker", sys.executable, "-m", "tests.fakes", FAKE_SECONDS="0.2")
    house.until(lambda: house.done(early) == 1, "the first keeps")

    house.hold.touch()
    job = job_actions.submit(house.services, request(grasps=32 * 24))[0].id
    house.until(lambda: house.services.index.jobs.tasks(job=job, state=State.RUNNING).items, "the worker has a task")
    house.processes["first"].kill()
    house.processes["first"].wait()
    house.until(lambda: house.says("second", "this controller leads"), "the second takes over")
    assert house.done(job) == 0
    house.hold.unlink()
    house.until(lambda: house.done(job) >= 2, "the second keeps")

    house.hold.touch()
    house.controller("third")
    house.until(lambda: house.says("third", "another controller leads"), "the third waits")
    house.processes["second"].send_signal(signal.SIGSTOP)
    house.until(lambda: house.says("third", "this controller leads"), "the third takes over")
    house.processes["second"].send_signal(signal.SIGCONT)
    house.until(lambda: house.says("second", "another leads now"), "the second notices")
    house.hold.unlink()

    house.until(lambda: house.services.index.jobs.get(job).state.is_final, "the job is done")
    tasks = house.services.index.jobs.tasks(job=job, limit=100).items
    assert {task.state for task in tasks} == {State.SUCCEEDED}
    assert [task.attempt for task in tasks] == [1] * 24, "no task was taken from its worker"
    assert house.says("worker", "synthesize took") == 1 + 24, "none was done twice"
    house.until(lambda: differences(house.services.index, house.services.store) == [], "the index is the store")

    # A controller that ends in order gives its lease back: the next one need not wait for it to run out.
    house.processes["third"].terminate()
    assert house.processes["third"].wait(60) == 0
    house.until(lambda: house.says("second", "this controller leads") == 2, "the second leads again")


@pytest.mark.slow
@pytest.mark.chaos
def test_one_that_is_started_again_under_its_name_need_not_wait(house: House) -> None:
    house.controller("first", GRASPD_CONTROLLER_NAME="node-1", GRASPD_LEASE_S="600")
    house.until(lambda: house.says("first", "this controller leads"), "the first leads")
    house.processes["first"].kill()
    house.processes["first"].wait()
    house.controller("again", GRASPD_CONTROLLER_NAME="node-1", GRASPD_LEASE_S="600")
    house.until(lambda: house.says("again", "this controller leads"), "it leads again")
