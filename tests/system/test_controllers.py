"""Several controllers, of which one leads."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from graspd.service.index.rebuild import differences
from graspd.service.model.states import State
from graspd.service.pipeline import job_actions
from graspd.service.pipeline.backends import Services
from graspd.service.queue.connection import redis_url
from graspd.service.queue.rq_queue import RqQueue
from graspd.service.run.embedded import server_command
from graspd.service.settings import Settings
from tests.conftest import REPOSITORY
from tests.fakes import add_assets, request
from tests.indexes import empty_index
from tests.service.conftest import wait_for_redis
from tests.waiting import until

LEASE_S = 2.0


class House:
    """Redis, controllers and a worker as processes, each with a log. While there is a file `hold` no task ends."""

    def __init__(self, folder: Path) -> None:
        self.settings = Settings(data_dir=folder / "data", lease_s=LEASE_S, controller_interval_s=0.3, task_s=0.0)
        self._logs = folder / "logs"
        self._logs.mkdir()
        self.hold = folder / "hold"
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self.start("redis", *server_command(self.settings))
        empty_index(self.settings.resolved_index_url).close()
        self.services = Services.open(self.settings)
        assert isinstance(self.services.queue, RqQueue)
        wait_for_redis(self.services.queue)
        add_assets(self.services)

    def start(self, name: str, *command: str, **more: str) -> None:
        environment = {
            **os.environ,
            "PYTHONPATH": str(REPOSITORY),
            "GRASPD_DATA_DIR": str(self.settings.data_dir),
            "GRASPD_REDIS_URL": redis_url(self.settings),
            "GRASPD_LEASE_S": str(self.settings.lease_s),
            "GRASPD_CONTROLLER_INTERVAL_S": "0.3",
            "GRASPD_TASK_S": "0",
            "GRASPD_LOG_FORMAT": "text",
            "FAKE_HOLD": str(self.hold),
            **more,
        }
        with (self._logs / f"{name}.log").open("ab") as log:
            self.processes[name] = subprocess.Popen(command, env=environment, stdout=log, stderr=log)

    def controller(self, name: str, **more: str) -> None:
        self.start(name, sys.executable, "-m", "graspd", "controller", **more)

    def says(self, name: str, what: str) -> int:
        """How often a process said something."""
        return len(re.findall(what, (self._logs / f"{name}.log").read_text()))

    def until(self, met: Callable[[], object], what: str) -> None:
        """Until a condition is met; a failure shows the logs."""
        until(met, what, logs=self._said)

    def done(self, job: str) -> int:
        return len(self.services.index.jobs.tasks(job=job, state=State.SUCCEEDED, limit=100).items)

    def _said(self) -> str:
        return "\n".join(f"--- {file.name}\n{file.read_text()[-1500:]}" for file in sorted(self._logs.iterdir()))

    def close(self) -> None:
        self.services.close()
        for name in reversed(self.processes):
            process = self.processes[name]
            process.send_signal(signal.SIGCONT)
            process.kill()
            process.wait()


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
