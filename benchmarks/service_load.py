"""Cost of the service alone: queue, indexer, workers, API with a million grasps; prints Markdown.

usage: python -m benchmarks.service_load queue|workers|indexer|api|beside [--index-url URL] [--data-dir DIR]

`api` needs a filled index: python -m benchmarks.large_index --data-dir DIR [--index-url URL].
Workers are simulated (tests.fakes), so only the service is measured."""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import httpx

import graspd.worker.process.engine as engine
import graspd.worker.process.main as worker_main
from graspd.api.access.keys import KeyFile, Scope
from graspd.service.index.index import Index
from graspd.service.model import names
from graspd.service.model.planning import create_task_message, plan_tasks, task_id
from graspd.service.model.records import JobRecord
from graspd.service.model.states import Priority, Stage, State
from graspd.service.pipeline import job_actions
from graspd.service.pipeline.backends import Services
from graspd.service.run.supervisor import Supervisor
from graspd.service.settings import Settings
from graspd.service.store.records import read_record
from graspd.service.store.store import open_store
from tests.fakes import add_assets, engine_of, fake_stages, make_shard, request
from tests.memory_queue import MemoryQueue

#: Least time of a batch of 32 grasps on two cores [s] (docs/explanation/performance.md).
BATCH_S: Final = 1.0


#: Number of requests of each kind.
REPEATS: Final = 100
#: Number of large jobs of one key, and their grasps, while another key submits small jobs.
LARGE_JOBS: Final = 5
LARGE: Final = 1_000_000


def cpu_s(pid: int) -> float:
    """Return the processor time of a process [s]; it depends less on other load than wall time."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


@contextmanager
def service(*, workers: int, task_s: float = 0.0, **settings: Any) -> Iterator[Services]:
    """Start `running` without an API and yield its services."""
    with running(workers=workers, task_s=task_s, api=False, **settings) as (_, services):
        yield services


@contextmanager
def running(*, workers: int, task_s: float, api: bool, **settings: Any) -> Iterator[tuple[Supervisor, Services]]:
    """Start a whole service of real processes, with workers that wait `task_s` per task."""
    os.environ["FAKE_SECONDS"] = str(task_s)
    with tempfile.TemporaryDirectory(prefix="graspd-bench-") as folder:
        wanted = Settings(data_dir=Path(folder), port=0, device="cpu", log_level="WARNING", **settings)
        fakes = (sys.executable, "-m", "tests.fakes")
        with Supervisor(wanted, workers=workers, api=api, worker_command=fakes) as supervisor:
            supervisor.wait_ready()
            services = Services.open(supervisor.settings)
            add_assets(services)
            yield supervisor, services
            services.close()


def run(services: Services, batches: int, seed: int) -> float:
    start = time.perf_counter()
    job = job_actions.submit(services, request(grasps=32 * batches, seed=seed), priority=Priority.BULK)[0].id
    while services.index.jobs.get(job).state is not State.SUCCEEDED:
        time.sleep(0.05)
    return time.perf_counter() - start


def queue() -> None:
    """Measure the overhead of a task: of the queue alone, then with shard, manifest and index."""
    spent: list[float] = []

    class Timed(engine.Runner):
        def run(self, *args: Any) -> Any:
            start = time.perf_counter()
            try:
                return super().run(*args)
            finally:
                spent.append(time.perf_counter() - start)

    with service(workers=0) as services:
        job_actions.submit(services, request(grasps=32 * 500), priority=Priority.BULK)
        engine.Runner = Timed  # type: ignore[misc]
        start = time.perf_counter()
        worker_main.run_worker(services.settings, start=engine_of(fake_stages()), max_tasks=400)
        whole = (time.perf_counter() - start) / len(spent)
    alone = whole - statistics.fmean(spent)
    say(f"| what | measured | share of a batch of {BATCH_S:g} s |\n| --- | --: | --: |")
    say(f"| queue, lease and events | {1000 * alone:.1f} ms | {alone / BATCH_S:.1%} |")
    say(f"| the same with shard, manifest and index | {1000 * whole:.1f} ms | {whole / BATCH_S:.1%} |")


def workers() -> None:
    """Measure tasks per second of N workers; each task waits half a second."""
    task_s = 0.5
    first = 0.0
    say("| workers | tasks/s | share of linear scaling |\n| --: | --: | --: |")
    for count in (1, 2, 4, 8):
        with service(workers=count, task_s=task_s) as services:
            run(services, 2 * count, 0)
            rate = 20 * count / run(services, 20 * count, 1)
        first = first or rate
        say(f"| {count} | {rate:.2f} | {rate / first / count:.0%} |")


def indexer(url: str | None) -> None:
    """Measure shards of 32 grasps that the controller indexes per second, a hundred per transaction."""
    with tempfile.TemporaryDirectory(prefix="graspd-bench-") as folder:
        index = Index(url or f"sqlite:///{folder}/index.sqlite")
        services = Services(Settings(data_dir=Path(folder)), open_store("memory://"), index, MemoryQueue())
        add_assets(services)
        job = job_actions.submit(services, request(grasps=32 * 1000, seed=time.time_ns() % 10**6))[0].id
        record = read_record(JobRecord, services.store, names.job_record_key(job))
        made = [
            make_shard(services.store, create_task_message(record, t, attempt=1, max_attempt=3))
            for t in plan_tasks(record)
        ]
        start = time.perf_counter()
        for begin in range(0, len(made), 100):
            index.write.add_manifests(made[begin : begin + 100])
        rate = len(made) / (time.perf_counter() - start)
        index.close()
    say("| what | shards | grasps |\n| --- | --: | --: |")
    say(f"| indexer | {rate:.0f} shards/s | {32 * rate:.0f} grasps/s |")


def api(data_dir: Path, url: str | None) -> None:
    """Measure the latency of sequential API requests with a filled index."""
    settings = Settings(
        data_dir=data_dir,
        port=0,
        requests_per_minute=0,
        address_requests_per_minute=0,
        concurrency=0,
        log_level="WARNING",
        **({"index_url": url} if url else {}),
    )
    with Supervisor(settings, workers=0) as supervisor:
        supervisor.wait_ready()
        with httpx.Client(base_url=supervisor.api_url, timeout=60, trust_env=False) as http:
            _requests(http, supervisor.pids["api"])


def _requests(http: httpx.Client, pid: int) -> None:
    job = http.get("/v1/jobs", params={"state": "succeeded"}).json()["items"][0]["id"]
    seeds = iter(range(time.time_ns() % 10**9, 2**31))

    def submit() -> httpx.Response:
        return http.post("/v1/jobs", json={"hand": "allegro", "object": "mug", "grasps": 320, "seed": next(seeds)})

    def get(path: str, **params: Any) -> Callable[[], httpx.Response]:
        return lambda: http.get(path, params=params)

    calls: dict[str, Callable[[], httpx.Response]] = {
        "submit a job of 10 batches": submit,
        "status of a job": get(f"/v1/jobs/{job}"),
        "list 50 jobs": get("/v1/jobs"),
        "list 50 grasps, best first": get("/v1/grasps"),
        "list 50 grasps of one hand, least penetration first": get(
            "/v1/grasps", hand="allegro", sort="penetration_depth_mm", order="asc"
        ),
        "list 50 valid grasps within three bounds": get(
            "/v1/grasps", valid="true", min_epsilon=0.2, min_contact_area_cm2=10, max_penetration_depth_mm=0.5
        ),
        "page: home": get("/"),
        "page: a job": get(f"/jobs/{job}"),
        "page: grasps": get("/grasps"),
    }
    say("| request | median | p95 | CPU of the API process |\n| --- | --: | --: | --: |")
    for name, call in calls.items():
        call().raise_for_status()
        times = []
        before = cpu_s(pid)
        for _ in range(REPEATS):
            start = time.perf_counter()
            call().raise_for_status()
            times.append(1000 * (time.perf_counter() - start))
        p95 = statistics.quantiles(times, n=20)[-1]
        cpu = 1000 * (cpu_s(pid) - before) / REPEATS
        say(f"| {name} | {statistics.median(times):.1f} ms | {p95:.1f} ms | {cpu:.1f} ms |")


def beside(url: str | None) -> None:
    """Measure how long small jobs of one key wait while another key's large jobs are queued."""
    with running(workers=2, task_s=1.0, api=True, **({"index_url": url} if url else {})) as (supervisor, services):
        keys = KeyFile(supervisor.settings.resolved_keys_file)
        large, small = (keys.add(name, Scope.SUBMIT) for name in ("large", "small"))
        seeds = iter(range(10**6))

        def post(http: httpx.Client, key: str, grasps: int) -> tuple[str, float]:
            wanted = request(grasps=grasps, seed=next(seeds)).model_dump(mode="json", exclude_defaults=True)
            start = time.perf_counter()
            answer = http.post("/v1/jobs", json=wanted, headers={"Authorization": f"Bearer {key}"})
            answer.raise_for_status()
            return answer.json()["id"], time.perf_counter() - start

        answers, queued = list[float](), list[float]()
        with httpx.Client(base_url=supervisor.api_url, timeout=120, trust_env=False) as http:
            of_large = [post(http, large, LARGE)[1] for _ in range(LARGE_JOBS)]
            start = time.perf_counter()
            while not answers or services.index.write.partly_entered_jobs():
                job, answered = post(http, small, 32)
                began, task = time.perf_counter(), task_id(job, Stage.SYNTHESIZE, 0)
                # A task that a worker has taken is no longer in the queue, nor queued in the index.
                while (
                    task not in services.queue.waiting_tasks() and services.index.jobs.task(task).state is State.QUEUED
                ):
                    time.sleep(0.01)
                answers.append(answered)
                queued.append(answered + time.perf_counter() - began)
                time.sleep(1.0)
            took = time.perf_counter() - start
    say(
        f"{LARGE_JOBS} jobs of {LARGE:,} grasps, each answered within {max(of_large):.2f} s, queued within "
        f"{took:.0f} s;"
    )
    say(f"at the same time {len(answers)} jobs of 32 grasps of another key:")
    say("| small job | first | median | slowest |\n| --- | --: | --: | --: |")
    for what, times in (("answered after", answers), ("in the queue after", queued)):
        say(f"| {what} | {times[0]:.2f} s | {statistics.median(times):.2f} s | {max(times):.2f} s |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["queue", "workers", "indexer", "api", "beside"])
    parser.add_argument("--data-dir", type=Path, help="folder of a filled index, for `api`")
    parser.add_argument("--index-url", help="PostgreSQL; default: SQLite")
    given = parser.parse_args()
    if given.what == "api":
        if given.data_dir is None:
            parser.error("`api` needs --data-dir with a filled index: see benchmarks.large_index")
        api(given.data_dir, given.index_url)
    elif given.what in ("indexer", "beside"):
        {"indexer": indexer, "beside": beside}[given.what](given.index_url)
    else:
        {"queue": queue, "workers": workers}[given.what]()


if __name__ == "__main__":
    main()
