"""The application as a whole: its socket, its imports, its OpenAPI document, its scrape."""

from __future__ import annotations

import asyncio
import socket
import subprocess
import sys
from functools import cache
from typing import Any

import pytest
import typer
from pydantic import TypeAdapter
from starlette.testclient import TestClient
from typer.core import TyperGroup

import graspd.cli
from api.app import create_app
from api.metrics import Metrics, Snapshot
from api.server import bind
from service.model.states import Stage
from service.model.workers import WorkerBeat
from service.pipeline.backends import Services
from service.pipeline.metrics import SERIES
from service.queue.port import QueueNow
from service.settings import Settings
from tests.conftest import REPOSITORY


@pytest.mark.parametrize("path", ["/v1/jobs", "/v1/datasets", "/", "/healthz"])
def test_the_first_request_builds_no_route(
    settings: Settings, services: Services, path: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    app = create_app(settings, services)

    def built_late(self: TypeAdapter[Any], *arguments: Any, **named: Any) -> None:
        raise AssertionError("a field of a route is built while a request waits")

    monkeypatch.setattr(TypeAdapter, "__init__", built_late)
    with TestClient(app, base_url="http://127.0.0.1:8000") as client:
        assert client.get(path).is_success


def test_answers_are_sent_without_delay() -> None:
    """Else Nagle holds an answer's body back for the 40 ms that a client waits before it acknowledges the head."""

    async def option() -> int:
        found: asyncio.Future[int] = asyncio.get_running_loop().create_future()

        def accepted(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            connection = writer.get_extra_info("socket")
            found.set_result(connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY))
            writer.close()

        async with await asyncio.start_server(accepted, sock=bind("127.0.0.1", 0)) as server:
            _, writer = await asyncio.open_connection(*server.sockets[0].getsockname())
            value = await found
            writer.close()
            await writer.wait_closed()
            return value

    assert asyncio.run(option()) == 1


STATES = ("checking", "idle", "busy", "stopping", "quarantined")


def test_workers_are_counted_in_every_state_that_they_can_be_in() -> None:
    """An alert on workers in quarantine asks for this very series; none is 0 and not absent."""
    snapshot = Snapshot()
    beats = [
        WorkerBeat(str(i), "h", 1, "cpu", "CPU", tuple(Stage), "0", state, "", "", "")
        for i, state in enumerate(["idle", "quarantined", "quarantined"])
    ]
    snapshot.add_queue(QueueNow(workers={beat.name: (beat, 0.1) for beat in beats}), is_kept=True)
    text = Metrics().render(snapshot).decode()
    assert all(state in SERIES["graspd_workers"].meaning for state in STATES)
    counts = {state: float(text.partition(f'graspd_workers{{state="{state}"}} ')[2].split()[0]) for state in STATES}
    assert counts == {"checking": 0, "idle": 1, "busy": 0, "stopping": 0, "quarantined": 2}


@pytest.mark.parametrize("lives", [True, False])
def test_the_controller_is_up_while_one_gives_signs_of_life(lives: bool) -> None:
    snapshot = Snapshot()
    snapshot.add_queue(QueueNow(), is_kept=lives)
    assert f"graspd_controller_up {float(lives)}" in Metrics().render(snapshot).decode().splitlines()


HEAVY = ("warp", "newton", "trimesh", "mujoco", "scipy", "yourdfpy", "worker")


@cache
def modules_after(statement: str) -> frozenset[str]:
    code = f"{statement}\nimport sys\nprint(*sorted({{name.partition('.')[0] for name in sys.modules}}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return frozenset(done.stdout.split())


@pytest.mark.parametrize("statement", ["import api.app", "import api.client.commands", "import api.client.client"])
def test_the_front_door_imports_no_engine(statement: str) -> None:
    assert modules_after(statement).isdisjoint(HEAVY)


@pytest.mark.parametrize("statement", ["import api.client.commands", "import api.client.dataset_commands"])
def test_a_command_line_needs_no_templates_and_no_server(statement: str) -> None:
    assert modules_after(statement).isdisjoint({"jinja2", "uvicorn", "worker"})


def test_commands_that_talk_http_need_no_web_framework_and_no_database() -> None:
    modules = ("client", "commands", "add_commands", "dataset_commands", "access_commands", "tag_commands")
    statement = "import " + ", ".join(f"api.client.{module}" for module in modules)
    assert modules_after(statement).isdisjoint({"fastapi", "starlette", "sqlalchemy", "redis"})


OVERVIEW = """
import contextlib, io, sys
import graspd.cli
sys.argv = ["graspd", "--help"]
with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
    graspd.cli.main()
"""


def test_the_overview_of_commands_imports_no_room() -> None:
    assert modules_after(OVERVIEW).isdisjoint({*HEAVY, "fastapi", "sqlalchemy", "h5py", "numpy"})


def operations(http: TestClient) -> dict[str, dict[str, object]]:
    paths = http.get("/openapi.json").json()["paths"]
    return {f"{method} {path}": operation for path, methods in paths.items() for method, operation in methods.items()}


def test_every_error_is_declared_as_a_problem_document(http: TestClient) -> None:
    for name, operation in operations(http).items():
        for status, answer in operation["responses"].items():  # type: ignore[attr-defined]
            if status.startswith("4"):
                assert set(answer["content"]) == {"application/problem+json"}, f"{name} {status}"


def test_everything_below_v1_declares_that_a_key_may_be_needed(http: TestClient) -> None:
    missing = [
        name
        for name, operation in operations(http).items()
        if "/v1/" in name and "401" not in operation["responses"]  # type: ignore[operator]
    ]
    assert missing == []


def test_the_page_of_the_api_lists_every_route(http: TestClient) -> None:
    page = (REPOSITORY / "docs" / "reference" / "http.md").read_text()
    assert [path for path in http.get("/openapi.json").json()["paths"] if f"`{path}`" not in page] == []


def test_no_reference_in_the_document_is_open(http: TestClient) -> None:
    text = http.get("/openapi.json").text
    schemas = http.get("/openapi.json").json()["components"]["schemas"]
    wanted = {part.partition('"')[0] for part in text.split("#/components/schemas/")[1:]}
    assert wanted <= set(schemas)


@pytest.mark.parametrize("name", [name for name, module, _, _ in graspd.cli.COMMANDS if module != "graspd.demo"])
def test_every_command_of_the_overview_opens(name: str) -> None:
    module = next(module for known, module, _, _ in graspd.cli.COMMANDS if known == name)
    root = typer.main.get_command(graspd.cli.build())
    assert isinstance(root, TyperGroup)
    assert graspd.cli.load(module, name) is not None
