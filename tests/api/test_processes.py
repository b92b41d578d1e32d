"""One word finds a job in the logs of all processes; metrics count what they did."""

import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from graspd.service.pipeline.backends import Services
from graspd.service.run.supervisor import Supervisor
from graspd.service.settings import Settings
from tests.fakes import add_assets
from tests.waiting import PATIENCE_S, until


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
