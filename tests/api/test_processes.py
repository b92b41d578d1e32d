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
from tests.api.factories import add_builtins
from tests.fakes import add_assets
from tests.service.conftest import wait_for_redis
from tests.waiting import PATIENCE_S, until

JOB = {"hand": "allegro", "object": "mug", "grasps": 32}


class Twins:
    """Two `graspd api` processes that know nothing but the data folder, and the Redis of that folder."""

    def __init__(self, folder: Path) -> None:
        self.settings = Settings(data_dir=folder)
        self.keys = KeyFile(self.settings.resolved_keys_file)
        self.tokens = {scope: self.keys.add(scope.value, scope) for scope in Scope}
        self._stack = ExitStack()

    def start(self) -> None:
        redis = self._run(server_command(self.settings))
        queue = RqQueue(connect(redis_url(self.settings), patience=0))
        wait_for_redis(queue)
        queue.close()
        assert redis.poll() is None
        services = Services.open(self.settings)
        add_builtins(services)
        services.close()
        command = [sys.executable, "-m", "graspd", "api", "--port", "0"]
        processes = [self._run(command, stderr=subprocess.PIPE) for _ in range(2)]
        self.urls = [_address(process) for process in processes]

    def client(self, number: int, scope: Scope = Scope.SUBMIT) -> httpx.Client:
        headers = {"Authorization": f"Bearer {self.tokens[scope]}"}
        client = httpx.Client(base_url=self.urls[number], headers=headers, trust_env=False, timeout=60)
        return self._stack.enter_context(client)

    def stop(self) -> None:
        self._stack.close()

    def _run(self, command: list[str], **options: Any) -> subprocess.Popen[bytes]:
        environment = {name: value for name, value in os.environ.items() if not name.startswith("GRASPD_")}
        environment["GRASPD_DATA_DIR"] = str(self.settings.data_dir)
        options = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL} | options
        process = subprocess.Popen(command, env=environment, **options)
        self._stack.callback(_end, process)
        return process


def _end(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(10)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    if process.stderr is not None:
        process.stderr.close()


def _address(process: subprocess.Popen[bytes]) -> str:
    """Where a process says that it answers, once it does."""
    assert process.stderr is not None
    for line in process.stderr:
        if b" at http://" in line:
            url = line.decode().split()[-1]
            break
    else:
        raise AssertionError(f"the API ended with {process.wait()}")
    # It listens before it says so: the answer comes when it is ready.
    assert httpx.get(f"{url}/healthz", trust_env=False, timeout=PATIENCE_S).status_code == 200
    return url


@pytest.fixture(scope="module")
def twins(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Twins]:
    made = Twins(tmp_path_factory.mktemp("twins"))
    try:
        made.start()
        yield made
    finally:
        made.stop()


def test_an_api_alone_finds_the_redis_of_its_data_folder(twins: Twins) -> None:
    client = twins.client(0)
    until(lambda: client.get("/readyz").json()["parts"]["redis"]["ok"], "Redis answers in time")


def test_what_one_process_is_told_the_other_knows(twins: Twins) -> None:
    made = twins.client(0).post("/v1/jobs", json=JOB)
    assert made.status_code == 202
    assert twins.client(1).get(made.headers["location"]).json()["id"] == made.json()["id"]
    assert twins.client(1).post("/v1/jobs", json=JOB).json()["id"] == made.json()["id"]
    once = {"Idempotency-Key": "once"}
    answers = [
        twins.client(n).post("/v1/jobs", json=JOB | {"seed": s}, headers=once) for n, s in ((0, 1), (1, 1), (1, 2))
    ]
    assert [answer.status_code for answer in answers] == [202, 202, 422]


def test_both_count_one_rate(twins: Twins) -> None:
    token = twins.keys.add("slow", Scope.READ, limits=KeyLimits(requests_per_minute=2))
    headers = {"Authorization": f"Bearer {token}"}
    clients = (twins.client(0), twins.client(1))
    assert [clients[i % 2].get("/v1/jobs", headers=headers).status_code for i in range(4)] == [200] * 2 + [429] * 2


def test_a_session_opens_both_until_its_key_is_revoked(twins: Twins) -> None:
    token = twins.keys.add("browser", Scope.READ)
    answer = httpx.post(f"{twins.urls[0]}/login", data={"key": token}, trust_env=False, timeout=60)
    cookies = {"graspd_session": answer.cookies["graspd_session"]}
    assert httpx.get(f"{twins.urls[1]}/v1/jobs", cookies=cookies, trust_env=False, timeout=60).status_code == 200
    twins.keys.revoke("browser")
    assert httpx.get(f"{twins.urls[1]}/v1/jobs", cookies=cookies, trust_env=False, timeout=60).status_code == 401


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
    """JSON lines of a process that are about that."""
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
