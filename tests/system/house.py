"""Redis, controllers and workers as processes that a test starts, kills and listens to one by one."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from graspd.service.model.states import State
from graspd.service.pipeline.backends import Services
from graspd.service.queue.connection import redis_url
from graspd.service.queue.rq_queue import RqQueue
from graspd.service.run.embedded import server_command
from graspd.service.settings import Settings
from tests.conftest import REPOSITORY
from tests.fakes import add_assets
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
