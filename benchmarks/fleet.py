"""Number of workers that a controller serves: real Redis, PostgreSQL and store, simulated workers.

usage: python -m benchmarks.fleet [--workers 64 512 4096] [--seconds 20] [--tasks 6000]
                                  [--sqlite] [--s3] [--json FILE]

Each number of workers has two runs. In the first run, all workers hold tasks, send heartbeats and report progress;
`--rate` tasks end per second. It measures the age of the oldest event that is not in the index, and the time to read
all leases. In the second run, tasks take no time; it measures the number of tasks per second through controller and
index. All processes share this machine, so the processor time of each part is also counted. `benchmarks.fleet_workers`
simulates the workers."""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from sqlalchemy import func, select

from benchmarks.service_load import cpu_s, say
from graspd.service.index.tables import tasks
from graspd.service.model import names
from graspd.service.model.states import Priority, Stage, State
from graspd.service.pipeline import job_actions
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.leading import PART
from graspd.service.queue.entries import lease_registry_key, queue_name
from graspd.service.queue.rq_queue import EVENTS, RqQueue
from graspd.service.run.embedded import server_command
from graspd.service.settings import Settings
from tests.fakes import add_assets, request
from tests.servers import PostgresServer, S3Server

#: Batches of a job, as in a dataset's cell of 3,200 grasps.
_BATCHES_A_JOB: Final = 100
_LOOK_EVERY_S: Final = 0.1
#: Time limit of each step [s].
_PATIENCE_S: Final = 240.0


@dataclass(frozen=True)
class Result:
    workers: int
    lag_s: float
    """Age of the oldest event that was not in the index: 95th percentile of the samples."""
    worst_lag_s: float
    sweep_ms: float
    """Median time to read all leases."""
    tasks_per_s: float
    controller_ms: float
    """Processor time of the controller per task."""
    database_ms: float
    redis_ms: float
    events: float
    """Events per task in the second run."""
    objects: float
    """Manifests in the store per task; the controller reads each once."""


class Machine:
    """Services of a fleet without workers; each runs in its own process."""

    def __init__(self, settings: Settings, services: Services, pids: dict[str, int]) -> None:
        self.settings, self.services, self._pids = settings, services, pids
        self._seed = 0

    @property
    def queue(self) -> RqQueue:
        assert isinstance(self.services.queue, RqQueue)
        return self.services.queue

    def submit(self, tasks: int) -> None:
        while tasks > 0:
            some = min(tasks, _BATCHES_A_JOB)
            self._seed += 1
            job_actions.submit(self.services, request(grasps=32 * some, seed=self._seed), priority=Priority.BULK)
            tasks -= some

    def cpu(self) -> dict[str, float]:
        """Return the processor time of each part and its children so far [s]."""
        return {name: _tree_cpu(pid) for name, pid in self._pids.items()}

    def lag_s(self) -> float:
        """Return the age of the oldest event that the controller has not acknowledged."""
        connection = self.queue.connection
        groups = connection.xinfo_groups(EVENTS)
        if not groups:
            return 0.0
        pending = connection.xpending(EVENTS, groups[0]["name"])
        oldest = pending["min"]
        if oldest is None:
            after = connection.xrange(EVENTS, b"(" + groups[0]["last-delivered-id"], count=1)
            oldest = after[0][0] if after else None
        seconds, micros = connection.time()
        return 0.0 if oldest is None else max(0.0, seconds + micros / 1e6 - int(oldest.split(b"-")[0]) / 1000)

    def sweep_s(self) -> float:
        """Return the time to read all leases."""
        begun = time.perf_counter()
        self.queue.leases()
        return time.perf_counter() - begun


@contextmanager
def machine(*, sqlite: bool, s3: bool) -> Iterator[Machine]:
    """Start a service of real processes; stop it after the block."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="graspd-fleet-")))
        options: dict[str, Any] = {
            "data_dir": folder,
            "log_level": "WARNING",
            "integrity_scan_mb_per_s": 0.0,
            "lease_s": 20.0,
        }
        pids = {}
        if not sqlite:
            server = stack.enter_context(PostgresServer())
            assert server.process is not None
            options["index_url"], pids["database"] = server.url(), server.process.pid
        if s3:
            bucket = stack.enter_context(S3Server())
            os.environ.update(bucket.environment)
            options["store_url"] = f"{bucket.url}/fleet"
        settings = Settings(**options, task_s=0)
        redis = _started(stack, server_command(settings), {})
        services = Services.open(settings)
        stack.callback(services.close)
        _wait(lambda: _answers(services), "Redis answers")
        add_assets(services)
        pids["controller"] = _started(stack, [sys.executable, "-m", "graspd", "controller"], environment(settings))
        _wait(lambda: services.queue.is_announced(PART), "a controller works")
        yield Machine(settings, services, pids | {"redis": redis})


@contextmanager
def fleet(settings: Settings, workers: int, task_s: float) -> Iterator[None]:
    """Start workers; stop them after the block."""
    with ExitStack() as stack:
        command = [sys.executable, "-m", "benchmarks.fleet_workers", str(workers), str(task_s)]
        _started(stack, command, environment(settings))
        yield


def environment(settings: Settings) -> dict[str, str]:
    """Return the settings as environment variables of a process."""
    given = {name: getattr(settings, name) for name in settings.model_fields_set}
    plain = {
        name: value.get_secret_value() if hasattr(value, "get_secret_value") else str(value)
        for name, value in given.items()
    }
    return {f"GRASPD_{name.upper()}": value for name, value in plain.items()}


def measure(workers: int, given: argparse.Namespace) -> Result:
    with machine(sqlite=given.sqlite, s3=given.s3) as at:
        task_s = workers / given.rate
        at.submit(workers + int(given.rate * (given.seconds + task_s + 30)))
        with fleet(at.settings, workers, task_s):
            held = at.queue.connection
            lists = [lease_registry_key(queue_name(priority, Stage.SYNTHESIZE)) for priority in Priority]
            _wait(lambda: sum(held.zcard(name) for name in lists) >= 0.9 * workers, "all workers hold a task")
            time.sleep(given.seconds / 2)
            lags, sweeps = _looks(at, given.seconds)
    with machine(sqlite=given.sqlite, s3=given.s3) as at:
        at.submit(given.tasks)
        before = at.cpu()
        begun = time.perf_counter()
        with fleet(at.settings, workers, 0.0):
            _wait(
                lambda: _finished(at.services) >= given.tasks,
                "all tasks are in the index",
                lambda: f"({_finished(at.services)} of {given.tasks})",
            )
            seconds = time.perf_counter() - begun
            spent = {name: 1000 * (used - before[name]) / given.tasks for name, used in at.cpu().items()}
            events = at.queue.connection.xinfo_stream(EVENTS)["entries-added"]
            objects = sum(1 for _ in at.services.store.list(names.SHARDS))
    return Result(
        workers=workers,
        lag_s=statistics.quantiles(lags, n=20)[-1],
        worst_lag_s=max(lags),
        sweep_ms=1000 * statistics.median(sweeps),
        tasks_per_s=given.tasks / seconds,
        controller_ms=spent["controller"],
        database_ms=spent.get("database", 0.0),
        redis_ms=spent["redis"],
        events=events / given.tasks,
        objects=objects / given.tasks,
    )


def _looks(at: Machine, seconds: float) -> tuple[list[float], list[float]]:
    lags, sweeps = [], []
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        for _ in range(9):
            lags.append(at.lag_s())
            time.sleep(_LOOK_EVERY_S)
        sweeps.append(at.sweep_s())
    return lags, sweeps


def _finished(services: Services) -> int:
    with services.index.database.read_transaction() as connection:
        done = select(func.count()).select_from(tasks).where(tasks.c.state == State.SUCCEEDED.value)
        return int(connection.scalar(done) or 0)


def _answers(services: Services) -> bool:
    try:
        services.queue.ping()
    except Exception:
        return False
    return True


def _started(stack: ExitStack, command: Sequence[str], environment: dict[str, str]) -> int:
    process = subprocess.Popen(command, env=os.environ | environment, stdout=subprocess.DEVNULL)
    stack.callback(process.wait)
    stack.callback(process.terminate)
    return process.pid


def _wait(met: Callable[[], bool], what: str, stands: Callable[[], object] = str) -> None:
    end = time.monotonic() + _PATIENCE_S
    while not met():
        if time.monotonic() > end:
            raise TimeoutError(f"after {_PATIENCE_S:g} s still not: {what} {stands()}")
        time.sleep(0.05)


def _tree_cpu(pid: int) -> float:
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return cpu_s(pid) + sum(cpu_s(int(child)) for child in children)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workers", type=int, nargs="+", default=[64, 512, 4096])
    parser.add_argument("--seconds", type=float, default=20.0, help="duration of the first run")
    parser.add_argument("--rate", type=float, default=100.0, help="tasks that end per second in the first run")
    parser.add_argument("--tasks", type=int, default=6000, help="tasks of the second run")
    parser.add_argument("--sqlite", action="store_true", help="index in a SQLite file instead of PostgreSQL")
    parser.add_argument("--s3", action="store_true", help="store on an S3 server instead of files")
    parser.add_argument("--json", type=Path, help="file for the figures")
    given = parser.parse_args()
    say(
        "| workers | event lag, p95 | event lag, largest | reading all leases | tasks/s | controller CPU per task "
        "| database CPU per task | Redis CPU per task | events per task | store reads per task |"
    )
    say(f"|{' --: |' * 10}")
    results = []
    for workers in given.workers:
        one = measure(workers, given)
        results.append(one)
        say(
            f"| {workers:,} | {one.lag_s:.2f} s | {one.worst_lag_s:.2f} s | {one.sweep_ms:.0f} ms "
            f"| {one.tasks_per_s:.0f} | {one.controller_ms:.1f} ms | {one.database_ms:.1f} ms "
            f"| {one.redis_ms:.1f} ms | {one.events:.2f} | {one.objects:.3f} |"
        )
    if given.json:
        given.json.write_text(json.dumps([asdict(one) for one in results], indent=2) + "\n")


if __name__ == "__main__":
    main()
