"""Two real API processes on one Redis answer alike; one word finds a job in the logs of all processes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import httpx
import pytest

from graspd.api.access.keys import KeyFile, KeyLimits, Scope
from graspd.service.pipeline.backends import Services
from graspd.service.queue.connection import connect, redis_url
from graspd.service.queue.rq_queue import RqQueue
from graspd.service.run.embedded import server_command
from graspd.service.run.supervisor import Supervisor
from graspd.service.settings import Settings
from tests.api.factories import add_builtins, bearer
from tests.fakes import add_assets
from tests.service.conftest import wait_for_redis
from tests.waiting import PATIENCE_S, until

JOB = {"hand": "allegro", "object": "mug", "grasps": 32}


def _address(process: subprocess.Popen[bytes]) -> str:
    """Where a process says that it answers, once it does."""
    assert process.stderr is not None
    line = next((line for line in process.stderr if b" at http://" in line), b"")
    assert line, f"the API ended with {process.wait()}"
    return line.decode().split()[-1]


@pytest.fixture
def twins(settings: Settings) -> Iterator[list[str]]:
    """Addresses of two `graspd api` processes that know nothing but the data folder, and the Redis of that folder."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("GRASPD_")}
    environment["GRASPD_DATA_DIR"] = str(settings.data_dir)
    with ExitStack() as stack:

        def run(command: list[str]) -> subprocess.Popen[bytes]:
            process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
            stack.enter_context(process)
            stack.callback(process.terminate)
            return process

        run(server_command(settings))
        queue = RqQueue(connect(redis_url(settings), patience=0))
        wait_for_redis(queue)
        queue.close()
        services = Services.open(settings)
        add_builtins(services)
        services.close()
        command = [sys.executable, "-m", "graspd", "api", "--port", "0"]
        yield [_address(process) for process in [run(command), run(command)]]


def test_two_processes_on_one_data_folder_are_one_service(keys: KeyFile, twins: list[str]) -> None:
    headers = bearer(keys.add("me", Scope.SUBMIT))
    clients = [httpx.Client(base_url=url, headers=headers, trust_env=False, timeout=60) for url in twins]
    until(lambda: clients[0].get("/readyz").json()["parts"]["redis"]["ok"], "it finds the Redis of its data folder")
    made = clients[0].post("/v1/jobs", json=JOB)
    assert made.status_code == 202
    assert clients[1].get(made.headers["location"]).json()["id"] == made.json()["id"]
    once = headers | {"Idempotency-Key": "once"}
    answers = [clients[n].post("/v1/jobs", json=JOB | {"seed": s}, headers=once) for n, s in ((0, 1), (1, 1), (1, 2))]
    assert [answer.status_code for answer in answers] == [202, 202, 422]
    slow = bearer(keys.add("slow", Scope.READ, limits=KeyLimits(requests_per_minute=2)))
    assert [clients[i % 2].get("/v1/jobs", headers=slow).status_code for i in range(4)] == [200] * 2 + [429] * 2
    login = httpx.post(f"{twins[0]}/login", data={"key": keys.add("browser", Scope.READ)}, trust_env=False, timeout=60)
    with httpx.Client(base_url=twins[1], cookies=login.cookies, trust_env=False, timeout=60) as browser:
        assert browser.get("/v1/jobs").status_code == 200
        keys.revoke("browser")
        assert browser.get("/v1/jobs").status_code == 401
    for client in clients:
        client.close()


@pytest.fixture(scope="module")
def followed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, dict[str, Any], Callable[[], str]]]:
    """A service with fake engines in which one job of two stages was submitted as request `follow-me` and has ended:
    its folder of logs, the job, and its metrics."""
    wanted = Settings(data_dir=tmp_path_factory.mktemp("followed"), port=0, controller_interval_s=0.2)
    with Supervisor(wanted, worker_command=(sys.executable, "-m", "tests.fakes")) as supervisor:
        supervisor.wait_ready(PATIENCE_S)
        services = Services.open(supervisor.settings)
        add_assets(services)
        with httpx.Client(base_url=supervisor.api_url, trust_env=False, timeout=60) as http:
            body = {"hand": "gripper", "object": "ball", "grasps": 64, "scenes": 1}
            job = http.post("/v1/jobs", json=body, headers={"X-Request-Id": "follow-me"}).json()
            until(lambda: http.get(f"/v1/jobs/{job['id']}").json()["state"] == "succeeded", "the job ends")
            told = 'graspd_jobs_ended_total{state="succeeded"}'
            until(lambda: told in http.get("/metrics").text, "the controller passes its sums on every two seconds")
            yield supervisor.settings.data_dir / "logs", job, lambda: http.get("/metrics").text
        services.close()


def lines_of(logs: Path, process: str, **about: str) -> list[dict[str, Any]]:
    found = [json.loads(line) for line in (logs / f"{process}.log").read_text().splitlines() if line.startswith("{")]
    return [line for line in found if all(line.get(name) == value for name, value in about.items())]


def test_a_request_and_its_job_are_in_the_logs_of_every_process(followed: Any) -> None:
    logs, job, _ = followed
    for process in ("api", "controller", "worker-0"):
        assert lines_of(logs, process, job=job["id"])
    assert lines_of(logs, "api", request="follow-me", job=job["id"])
    lines = lines_of(logs, "worker-0", request="follow-me", job=job["id"])
    # Two batches of two stages; the controller queues the second stage.
    assert len({line["task"] for line in lines}) == 4


def test_metrics_tell_what_the_service_did(followed: Any) -> None:
    told = followed[2]().splitlines()
    for line in (
        'graspd_grasps_total{verdict="all"} 64.0',
        'graspd_shards_total{stage="synthesize"} 2.0',
        'graspd_shards_total{stage="scene"} 2.0',
        'graspd_stage_seconds_count{stage="scene"} 2.0',
        'graspd_jobs_ended_total{state="succeeded"} 1.0',
        'graspd_workers{state="idle"} 1.0',
        "graspd_controller_up 1.0",
        'graspd_part_up{part="store"} 1.0',
    ):
        assert line in told
