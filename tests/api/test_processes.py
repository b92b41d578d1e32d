"""One word finds a job in the logs of all processes, metrics tell what they did, and a request is one trace."""

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from opentelemetry.sdk.trace.export import SimpleSpanProcessor
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter
from starlette.testclient import TestClient

from graspd.service import telemetry
from graspd.service.model.planning import message_of, plan
from graspd.service.model.states import Stage
from graspd.service.pipeline.backends import Services
from graspd.service.run.supervisor import Supervisor
from graspd.service.settings import Settings
from graspd.worker.process.runner import Runner
from graspd.worker.stages.context import TaskContext
from tests.fakes import add_assets, fake_stages, record_of
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


_PARENT = "00-" + "a" * 32 + "-" + "b" * 16 + "-01"


@pytest.fixture
def spans(monkeypatch: pytest.MonkeyPatch) -> InMemorySpanExporter:
    exporter = InMemorySpanExporter()
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", "http://127.0.0.1:9")
    monkeypatch.setattr("opentelemetry.sdk.trace.export.BatchSpanProcessor", lambda _: SimpleSpanProcessor(exporter))
    monkeypatch.setattr(telemetry, "_tracer", None)
    telemetry.set_up_tracing("test")
    return exporter


def test_a_task_is_in_its_requests_trace(spans: InMemorySpanExporter, http: TestClient, services: Services) -> None:
    body = {"hand": "allegro", "object": "mug", "grasps": 32}
    made = http.post("/v1/jobs", json=body, headers={"traceparent": _PARENT}).json()
    record = record_of(services, made["id"])
    task = next(task for task in plan(record) if task.stage is Stage.SYNTHESIZE)
    message = message_of(record, task, attempt=1, max_attempt=3)
    runner = Runner(fake_stages(), worker="w", publish=lambda event: None)
    runner.run(message.model_dump(mode="json", by_alias=True), TaskContext(services.store))
    found = {span.name: span for span in spans.get_finished_spans()}
    request, work = found["HTTP POST"], found["task synthesize"]
    assert f"{request.context.trace_id:032x}" == "a" * 32
    assert work.context.trace_id == request.context.trace_id and work.parent is not None
    assert work.parent.span_id == request.context.span_id
    assert dict(work.attributes or {})["graspd.outcome"] == "finished"
    assert dict(request.attributes or {})["http.route"] == "/v1/jobs"


def test_without_an_endpoint_nothing_of_the_sdk_is_imported() -> None:
    code = (
        "import sys; from graspd.service import telemetry; telemetry.set_up_tracing('api')\n"
        "with telemetry.span('x'): assert telemetry.traceparent() == ''\n"
        "assert not [name for name in sys.modules if name.startswith('opentelemetry')]"
    )
    environment = {"PATH": "/usr/bin:/bin"}
    subprocess.run([sys.executable, "-c", code], check=True, env=environment)
