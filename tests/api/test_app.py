"""The application as a whole: socket, OpenAPI, scrape, problem documents, and logs of all processes."""

import asyncio
import json
import socket
import sys
from collections.abc import Callable, Iterator
from operator import attrgetter
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import httpx
import pytest
from fastapi import FastAPI
from pydantic import TypeAdapter
from starlette.responses import StreamingResponse
from starlette.testclient import TestClient

from graspd.api.app import create_app
from graspd.api.metrics import Metrics, MetricsSnapshot
from graspd.service.index.rebuild import rebuild
from graspd.service.model.errors import IndexUnavailable, QueueUnavailable, StoreUnavailable
from graspd.service.model.series import SERIES
from graspd.service.pipeline.backends import Services
from graspd.service.queue.port import QueueStatus
from graspd.service.run.address import bind_socket
from graspd.service.run.supervisor import Supervisor
from graspd.service.settings import Settings
from tests.api.conftest import BASE_URL
from tests.api.factories import add_job
from tests.conftest import REPOSITORY
from tests.damage import overwrite
from tests.fakes import add_assets, beat_of
from tests.indexes import empty_index
from tests.waiting import PATIENCE_S, until


def test_the_first_requests_build_no_route(app: FastAPI, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        TypeAdapter, "__init__", Mock(side_effect=AssertionError("a field of a route is built while a request waits"))
    )
    with TestClient(app, base_url=BASE_URL) as client:
        assert all(client.get(path).is_success for path in ("/v1/jobs", "/v1/datasets", "/", "/healthz"))


def test_answers_are_sent_without_delay() -> None:
    """Else Nagle holds an answer's body back for the 40 ms that a client waits before it acknowledges the head."""

    async def option() -> int:
        found: asyncio.Future[int] = asyncio.get_running_loop().create_future()

        def accepted(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            connection = writer.get_extra_info("socket")
            found.set_result(connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY))
            writer.close()

        async with await asyncio.start_server(accepted, sock=bind_socket("127.0.0.1", 0)) as server:
            _, writer = await asyncio.open_connection(*server.sockets[0].getsockname())
            value = await found
            writer.close()
            await writer.wait_closed()
            return value

    assert asyncio.run(option()) == 1


def test_workers_are_counted_in_every_state_that_they_can_be_in() -> None:
    """An alert on workers in quarantine asks for this very series; none is 0 and not absent."""
    snapshot = MetricsSnapshot()
    beats = [beat_of(str(i), state=state) for i, state in enumerate(["idle", "quarantined", "quarantined"])]
    snapshot.add_queue(QueueStatus(workers={beat.name: (beat, 0.1) for beat in beats}), is_kept=True)
    text = Metrics().render(snapshot).decode()
    expected = {"checking": 0, "idle": 1, "busy": 0, "stopping": 0, "quarantined": 2}
    assert all(state in SERIES["graspd_workers"].meaning for state in expected)
    assert "graspd_controller_up 1.0" in text.splitlines()
    counts = {state: float(text.partition(f'graspd_workers{{state="{state}"}} ')[2].split()[0]) for state in expected}
    assert counts == expected


def test_every_error_is_a_problem_document_and_v1_may_need_a_key(http: TestClient) -> None:
    paths = http.get("/openapi.json").json()["paths"]
    operations = {f"{verb} {path}": one for path, methods in paths.items() for verb, one in methods.items()}
    for name, operation in operations.items():
        answers: Any = operation["responses"]
        for status in [status for status in answers if status.startswith("4")]:
            assert set(answers[status]["content"]) == {"application/problem+json"}, f"{name} {status}"
        assert "/v1/" not in name or "401" in answers, name


def test_the_page_of_the_api_lists_every_route(http: TestClient) -> None:
    page = (REPOSITORY / "docs" / "reference" / "http.md").read_text()
    answer = http.get("/openapi.json")
    assert [path for path in answer.json()["paths"] if f"`{path}`" not in page] == []
    wanted = {part.partition('"')[0] for part in answer.text.split("#/components/schemas/")[1:]}
    assert wanted <= set(answer.json()["components"]["schemas"])


def asked_anew(app: FastAPI) -> dict[str, object]:
    app.state.overview._probes._known = None
    with TestClient(app, base_url="http://127.0.0.1:8000") as http:
        answer = http.get("/readyz")
        return {"status": answer.status_code, **answer.json()["parts"]["index"]}


def test_an_index_that_lacks_what_the_store_has_is_not_ready(settings: Settings, services: Services) -> None:
    record = add_job(services)
    fresh = empty_index(f"sqlite:///{settings.data_dir / 'fresh.sqlite'}")
    lost = Services(settings, services.store, fresh, services.queue)
    app = create_app(settings, lost)
    fresh.write.add_job(record)
    assert (found := asked_anew(app))["status"] == 503
    assert not found["ok"] and "controller" in str(found["detail"])
    rebuild(fresh, services.store)
    assert asked_anew(app)["status"] == 200
    fresh.close()


def test_an_index_without_damaged_records_names_them(settings: Settings, services: Services) -> None:
    key = f"jobs/{add_job(services).id}/job.json"
    app = create_app(settings, services)
    overwrite(services.store, key, b'{"x": 1}')
    rebuild(services.index, services.store)
    found = asked_anew(app)
    assert found["status"] == 200 and key in str(found["detail"])


JOB = {"hand": "allegro", "object": "mug", "grasps": 32}
PLANE = {"kind": "half_space"}
FLAT = {"supports": [PLANE, {"kind": "box", "size": [0, 1, 1]}]}
PLACED = {"supports": [PLANE], "target": [0, 0, 0, 1, 0, 0, 0], "neighbours": [{"object": "a"}]}


def problem(answer: Any, status: int, slug: str) -> dict[str, Any]:
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    document = answer.json()
    assert document["type"] == f"/problems/{slug}" and document["status"] == status
    assert document["request_id"] == answer.headers["x-request-id"] and "\n" not in document["detail"]
    return document


def test_a_field_in_error_is_pointed_at(http: TestClient) -> None:
    for change, pointer, words in (
        ({"grasps": 0}, "#/grasps", "must be at least 1"),
        ({"fidelity": "perfect"}, "#/fidelity", "draft, standard, fine"),
        ({"seed": "x"}, "#/seed", "whole number"),
        ({"colour": "red"}, "#/colour", "is not known"),
        ({"views": 3}, "#", "scenes >= 1"),
        ({"hand": "../etc"}, "#/hand", "at most 64 letters, digits, dots, dashes and underscores"),
        ({"scene": "tabel"}, "#/scene", "did you mean table?"),  # codespell:ignore tabel
        ({"scene": FLAT}, "#/scene", "must be more than 0.0001"),
        ({"scene": "bin", "method": "graspit"}, "#", "plans around free objects only"),
        ({"scene": "bin", "neighbours": ["../block"]}, "#/neighbours", "must begin with a letter"),
        ({"scene": PLACED}, "#", "give all"),
    ):
        first = problem(http.post("/v1/jobs", json=JOB | change), 422, "invalid-input")["errors"][0]
        assert first["pointer"].startswith(pointer) and words in first["detail"], change
    assert http.get("/v1/jobs").json()["items"] == []
    for limit in (0, 201):
        problem(http.get("/v1/jobs", params={"limit": limit}), 422, "invalid-input")


def test_a_body_that_is_no_json_or_too_large_is_refused(http: TestClient) -> None:
    answer = http.post("/v1/jobs", content=b"{hand: allegro", headers={"Content-Type": "application/json"})
    assert "not JSON" in problem(answer, 400, "bad-request")["detail"]
    for content in (b" " * (2 << 20), (b" " * 65536 for _ in range(32))):
        problem(http.post("/v1/jobs", content=content), 413, "too-large")


def test_what_is_unknown_is_named(http: TestClient) -> None:
    for kind, name in (("hand", "claw"), ("object", "teapot")):
        assert name in problem(http.post("/v1/jobs", json=JOB | {kind: name}), 404, "not-found")["detail"]
    for path in ("/v1/jobs/none", "/v1/shards/none", "/v1/shards/none/file", "/v1/hands/none"):
        assert "none" in problem(http.get(path), 404, "not-found")["detail"]
    answer = http.get("/v1/nowhere")
    problem(answer, 404, "not-found")
    assert "default-src 'none'" in answer.headers["content-security-policy"]
    assert "unsafe" not in answer.headers["content-security-policy"]
    assert answer.headers["x-content-type-options"] == "nosniff"


@pytest.mark.parametrize(
    ("part", "method", "error", "slug"),
    [
        ("queue", "ping", QueueUnavailable("Redis does not answer"), "queue-unavailable"),
        ("store", "put", StoreUnavailable("the store cannot be written"), "store-unavailable"),
        ("index.write", "enter_job", IndexUnavailable("the index does not answer"), "index-unavailable"),
    ],
)
def test_a_part_that_is_away_is_503_and_worth_another_try(
    http: TestClient, services: Services, monkeypatch: pytest.MonkeyPatch, part: str, method: str, error: Any, slug: str
) -> None:
    monkeypatch.setattr(type(attrgetter(part)(services)), method, Mock(side_effect=error))
    answer = http.post("/v1/jobs", json=JOB)
    assert problem(answer, 503, slug)["detail"] == str(error)
    assert int(answer.headers["retry-after"]) > 0


def test_an_answer_that_breaks_off_gets_no_second_one(app: FastAPI) -> None:
    app.add_api_route("/v1/half", lambda: StreamingResponse(bytes(1 // left) for left in (1, 0)))
    with TestClient(app, base_url=BASE_URL) as http, pytest.raises(ZeroDivisionError):
        http.get("/v1/half")


def test_an_unforeseen_error_tells_no_detail(app: FastAPI, http: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(app.state.overview, "stats", Mock(side_effect=RuntimeError("secret: /home/someone")))
    assert "secret" not in str(problem(http.get("/v1/stats"), 500, "internal"))
    page = http.get("/", headers={"Accept": "text/html"})
    assert (page.status_code, page.headers["content-type"]) == (500, "text/html; charset=utf-8")
    assert "secret" not in page.text and page.headers["x-request-id"] in page.text


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
