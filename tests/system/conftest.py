"""A whole service of real processes on a free port, with the workers' engine replaced by `tests.fakes`."""

import os
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from graspd.service.index.views import JobView
from graspd.service.model.domain import JobRequest
from graspd.service.pipeline import job_actions
from graspd.service.pipeline.backends import Services
from graspd.service.run.supervisor import Supervisor
from graspd.service.settings import Settings
from tests.fakes import add_assets
from tests.indexes import empty_index
from tests.waiting import PATIENCE_S, until


class System:
    """A running service and the services of it that a test looks at."""

    def __init__(self, supervisor: Supervisor, hold: Path, *, fakes: bool = True) -> None:
        """While there is a file `hold`, fake workers end no task."""
        self.supervisor = supervisor
        self.hold = hold
        self.services = Services.open(supervisor.settings)
        if fakes:
            add_assets(self.services)

    def submit(self, wanted: JobRequest) -> str:
        return job_actions.submit(self.services, wanted)[0].id

    def until(self, met: Callable[[], Any], what: str, *, seconds: float = PATIENCE_S) -> None:
        """Until a condition is met; a failure shows the logs."""
        until(met, what, seconds=seconds, logs=self.logs)

    def finish(self, *jobs: str, seconds: float = PATIENCE_S) -> list[JobView]:
        is_done = lambda job: self.services.index.jobs.get(job).state.is_final  # noqa: E731
        self.until(lambda: all(map(is_done, jobs)), f"{len(jobs)} jobs done", seconds=seconds)
        return [self.services.index.jobs.get(job) for job in jobs]

    def kill(self, name: str) -> int:
        """kill -9 a child; returns its pid."""
        pid = self.supervisor.pids[name]
        os.kill(pid, signal.SIGKILL)
        return pid

    def logs(self) -> str:
        files = sorted((self.supervisor.settings.data_dir / "logs").glob("*.log"))
        return "\n".join(f"--- {file.name}\n{file.read_text(errors='replace')[-1500:]}" for file in files)


Started = Callable[..., System]


@pytest.fixture
def start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Started]:
    """Starts a service, of real workers if `fakes` is False; `environment` is for its workers' fakes.
    Everything is stopped at the end."""
    running: list[System] = []

    def make(workers: int = 1, *, fakes: bool = True, api: bool = False, environment: Any = (), **of: Any) -> System:
        for name, value in {"FAKE_HOLD": str(tmp_path / "hold"), **dict(environment)}.items():
            monkeypatch.setenv(name, value)
        quick = {"controller_interval_s": 0.5, "task_s": 0.0, **of}
        wanted = Settings(data_dir=tmp_path / "data", port=0, device="cpu", **quick)
        command = ("-m", "tests.fakes") if fakes else ("-m", "graspd", "worker")
        supervisor = Supervisor(wanted, workers=workers, api=api, worker_command=(sys.executable, *command))
        empty_index(wanted.resolved_index_url).close()
        supervisor.start()
        try:
            supervisor.wait_ready(PATIENCE_S)
            running.append(System(supervisor, tmp_path / "hold", fakes=fakes))
        except BaseException:
            supervisor.stop()
            raise
        return running[-1]

    yield make
    for system in running:
        system.services.close()
        system.supervisor.stop()


def alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False
    return state != "Z"
