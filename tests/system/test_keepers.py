"""Several keepers: one works, and where it is killed or stands still another goes on."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from service.model.domain import State
from service.pipeline import job_actions
from service.pipeline.backends import Parts
from service.queue.address import redis_url
from service.queue.rq_queue import RqQueue
from service.run.embedded import server_command
from service.settings import Settings
from tests.conftest import REPOSITORY
from tests.fakes import add_assets, request
from tests.service.conftest import wait_for_redis

LEASE_S = 2.0


class House:
    """Redis, keepers and a worker as processes, each with a log."""

    def __init__(self, folder: Path) -> None:
        self.settings = Settings(data_dir=folder / "data", lease_s=LEASE_S, keeper_interval_s=0.3)
        self._logs = folder / "logs"
        self._logs.mkdir()
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self.start("redis", *server_command(self.settings))
        self.parts = Parts.open(self.settings)
        assert isinstance(self.parts.queue, RqQueue)
        wait_for_redis(self.parts.queue, 60)
        add_assets(self.parts)

    def start(self, name: str, *command: str, **more: str) -> None:
        environment = {
            **os.environ,
            "PYTHONPATH": str(REPOSITORY),
            "GRASPD_DATA_DIR": str(self.settings.data_dir),
            "GRASPD_REDIS_URL": redis_url(self.settings),
            "GRASPD_LEASE_S": str(LEASE_S),
            "GRASPD_KEEPER_INTERVAL_S": "0.3",
            "GRASPD_LOG_FORMAT": "text",
            **more,
        }
        with (self._logs / f"{name}.log").open("ab") as log:
            self.processes[name] = subprocess.Popen(command, env=environment, stdout=log, stderr=log)

    def keeper(self, name: str, **more: str) -> None:
        self.start(name, sys.executable, "-m", "graspd", "keeper", **more)

    def says(self, name: str, what: str) -> int:
        """How often a process said something."""
        return len(re.findall(what, (self._logs / f"{name}.log").read_text()))

    def until(self, met: Callable[[], object], what: str, seconds: float = 90.0) -> float:
        """Seconds until a condition is met; fails when it takes longer than that."""
        start = time.monotonic()
        while not met():
            logs = "\n".join(f"--- {file.name}\n{file.read_text()[-1500:]}" for file in self._logs.iterdir())
            assert time.monotonic() - start < seconds, f"still not: {what}\n{logs}"
            time.sleep(0.02)
        return time.monotonic() - start

    def done(self, job: str) -> int:
        return len(self.parts.index.jobs.tasks(job=job, state=State.SUCCEEDED, limit=100).items)

    def close(self) -> None:
        self.parts.close()
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
def test_a_keeper_that_is_killed_or_stands_still_gives_way_and_nothing_is_lost(house: House) -> None:
    house.keeper("first")
    house.until(lambda: house.says("first", "this keeper leads"), "the first leads")
    house.keeper("second")
    house.until(lambda: house.says("second", "another keeper leads"), "the second waits")
    job = job_actions.submit(house.parts, request(grasps=32 * 24))[0].id
    house.start("worker", sys.executable, "-m", "tests.fakes", FAKE_SECONDS="0.4")
    house.until(lambda: house.done(job) >= 2, "the first keeps")

    house.processes["first"].kill()
    house.processes["first"].wait()
    took = house.until(lambda: house.says("second", "this keeper leads"), "the second takes over")
    assert took < LEASE_S * 4 / 3 + 3, "a lease, a look, and a busy machine"
    before = house.done(job)
    house.until(lambda: house.done(job) >= before + 2, "the second keeps")

    house.keeper("third")
    house.until(lambda: house.says("third", "another keeper leads"), "the third waits")
    house.processes["second"].send_signal(signal.SIGSTOP)
    house.until(lambda: house.says("third", "this keeper leads"), "the third takes over")
    house.processes["second"].send_signal(signal.SIGCONT)
    house.until(lambda: house.says("second", "another leads now"), "the second notices")

    house.until(lambda: house.parts.index.jobs.get(job).state.is_final, "the job is done")
    tasks = house.parts.index.jobs.tasks(job=job, limit=100).items
    assert {task.state for task in tasks} == {State.SUCCEEDED}
    assert [task.attempt for task in tasks] == [1] * 24, "no task was taken from its worker"
    assert house.says("worker", "synthesize took") == 24, "none was done twice"

    # A keeper that ends in order gives its lease back: the next one need not wait for it to run out.
    house.processes["third"].terminate()
    assert house.processes["third"].wait(60) == 0
    house.until(lambda: house.says("second", "this keeper leads") == 2, "the second leads again")


@pytest.mark.chaos
def test_one_that_is_started_again_under_its_name_need_not_wait(house: House) -> None:
    house.keeper("first", GRASPD_KEEPER_NAME="node-1", GRASPD_LEASE_S="600")
    house.until(lambda: house.says("first", "this keeper leads"), "the first leads")
    house.processes["first"].kill()
    house.processes["first"].wait()
    house.keeper("again", GRASPD_KEEPER_NAME="node-1", GRASPD_LEASE_S="600")
    house.until(lambda: house.says("again", "this keeper leads"), "it leads again")
