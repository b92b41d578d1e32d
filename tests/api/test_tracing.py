"""With OpenTelemetry a request and the tasks it caused are one trace; without it nothing is sent."""

from __future__ import annotations

import subprocess
import sys

import pytest
from opentelemetry.sdk.trace.export import SimpleSpanProcessor
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter
from starlette.testclient import TestClient

from graspd.service import telemetry
from graspd.service.model.planning import message_of, plan
from graspd.service.model.states import Stage
from graspd.service.pipeline.backends import Services
from graspd.worker.process.runner import Runner
from graspd.worker.stages.context import TaskContext
from tests.fakes import fake_stages, record_of

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
    assert work.context.trace_id == request.context.trace_id
    assert work.parent is not None
    assert work.parent.span_id == request.context.span_id
    assert dict(work.attributes or {})["graspd.outcome"] == "finished"
    assert dict(request.attributes or {})["http.route"] == "/v1/jobs"


def test_without_an_endpoint_nothing_of_the_sdk_is_imported() -> None:
    code = (
        "import sys; from service import telemetry; telemetry.set_up_tracing('api')\n"
        "with telemetry.span('x'): assert telemetry.traceparent() == ''\n"
        "assert not [name for name in sys.modules if name.startswith('opentelemetry')]"
    )
    environment = {"PATH": "/usr/bin:/bin"}
    subprocess.run([sys.executable, "-c", code], check=True, env=environment)
