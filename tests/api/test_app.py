"""The application as a whole: its socket, its OpenAPI document, its scrape."""

import asyncio
import socket
from typing import Any
from unittest.mock import Mock

import pytest
from fastapi import FastAPI
from pydantic import TypeAdapter
from starlette.testclient import TestClient

from graspd.api.app import create_app
from graspd.api.metrics import Metrics, MetricsSnapshot
from graspd.service.index.rebuild import rebuild
from graspd.service.model.series import SERIES
from graspd.service.pipeline.backends import Services
from graspd.service.queue.port import QueueStatus
from graspd.service.run.address import bind_socket
from graspd.service.settings import Settings
from tests.api.conftest import BASE_URL
from tests.api.factories import add_job
from tests.conftest import REPOSITORY
from tests.damage import overwrite
from tests.fakes import beat_of
from tests.indexes import empty_index


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
