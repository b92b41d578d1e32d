"""Controller, workers, port and clocks as the doctor sees them, on a real Redis and real sockets."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import pytest

from graspd.service.model.clock import timestamp
from graspd.service.model.states import Priority, Stage
from graspd.service.model.version import PACKAGE_VERSION
from graspd.service.pipeline.leading import PART
from graspd.service.queue.rq_queue import WORKERS, RqQueue, worker_key
from graspd.service.run.address import record_address
from graspd.service.run.doctor.checks import Condition
from graspd.service.run.doctor.fleet import clocks, controller, port, workers
from graspd.service.settings import Settings
from tests.fakes import beat_of
from tests.servers import PostgresServer, free_ports
from tests.service.queue.test_queue import task


@pytest.fixture
def settings(rq_queue: RqQueue, redis_server: str, tmp_path: Path) -> Settings:
    return Settings(data_dir=tmp_path, redis_url=redis_server)


def present(queue: RqQueue, name: str = "w", **facts: Any) -> None:
    """A worker that gave a sign of life."""
    beat = beat_of(name, **{"host": "node1", "version": PACKAGE_VERSION, **facts})
    queue.connection.sadd(WORKERS, name)
    queue.connection.set(worker_key(name), json.dumps(asdict(beat)), ex=60)


def test_a_controller_that_lives_and_one_that_does_not(settings: Settings, rq_queue: RqQueue) -> None:
    found = controller(settings)
    assert not found.ok
    assert found.fix == "graspd controller"
    rq_queue.announce(PART, 60)
    assert controller(settings).condition is Condition.GOOD


def test_workers_that_fit_are_counted(settings: Settings, rq_queue: RqQueue) -> None:
    assert workers(settings).condition is Condition.WARNING, "none, and nothing waits"
    present(rq_queue)
    present(rq_queue, "v", state="busy", host="node2")
    found = workers(settings)
    assert found.condition is Condition.GOOD
    assert "1 busy, 1 idle, on 2 machines" in found.message


@pytest.mark.parametrize(
    ("facts", "told", "fix"),
    [
        ({"version": "0.0.9"}, "0.0.9 on node1", f"install graspd {PACKAGE_VERSION}"),
        ({"state": "quarantined", "reason": "no driver"}, "no driver", "on node1: graspd doctor"),
    ],
)
def test_workers_that_do_not_fit_are_bad(
    settings: Settings, rq_queue: RqQueue, facts: dict[str, Any], told: str, fix: str
) -> None:
    present(rq_queue)
    present(rq_queue, "ill", **facts)
    found = workers(settings)
    assert not found.ok
    assert told in found.message
    assert fix in found.fix


def test_tasks_of_a_stage_that_nobody_serves_are_bad(settings: Settings, rq_queue: RqQueue) -> None:
    present(rq_queue, stages=(Stage.INGEST, Stage.SCENE))
    rq_queue.enqueue([task("a", stage=Stage.RENDER), task("b", stage=Stage.SCENE)], Priority.BULK)
    found = workers(settings)
    assert not found.ok
    assert "1 tasks wait, and no worker takes render" in found.message
    assert found.fix == "graspd worker --stages render"


def test_where_nothing_runs_nothing_is_asked(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path)
    assert {look(settings).condition for look in (controller, workers, clocks)} == {Condition.SKIPPED}


def test_clocks_that_agree_are_good(settings: Settings, rq_queue: RqQueue) -> None:
    present(rq_queue)
    found = clocks(settings)
    assert found.condition is Condition.GOOD, found
    assert "Redis" in found.message


@pytest.mark.parametrize(
    ("ahead_s", "condition"),
    [(-60.0, Condition.WARNING), (60.0, Condition.WARNING), (3600.0, Condition.BAD), (-3.0, Condition.GOOD)],
)
def test_a_machine_whose_clock_is_off_is_named(
    settings: Settings, rq_queue: RqQueue, ahead_s: float, condition: Condition
) -> None:
    """Three seconds ago is as old as a beat may be."""
    present(rq_queue, seen=timestamp(-ahead_s))
    found = clocks(settings)
    assert found.condition is condition, found
    if condition is not Condition.GOOD:
        assert "node1" in found.message


@pytest.mark.postgres
def test_the_clock_of_the_database_is_asked(tmp_path: Path, postgres_server: PostgresServer) -> None:
    found = clocks(Settings(data_dir=tmp_path, index_url=postgres_server.database()))
    assert found.condition is Condition.GOOD
    assert "PostgreSQL" in found.message


@contextmanager
def answering(status: int, body: str) -> Iterator[int]:
    """A server that says the same to everything; gives its port."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(status)
            self.end_headers()
            self.wfile.write(body.encode())

        def log_message(self, *_: object) -> None:
            """Quiet."""

    server = HTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield server.server_address[1]
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


READY = json.dumps({"ok": True, "parts": {"redis": {"ok": True}}})
UNREADY = json.dumps({"ok": False, "parts": {"redis": {"ok": True}, "store": {"ok": False}}})


@pytest.mark.parametrize(
    ("status", "body", "ok", "told"),
    [
        (200, READY, True, "is ready"),
        (503, UNREADY, False, "not ready: store"),
        (200, "<html>a wiki</html>", False, "no graspd"),
        (404, "{}", False, "no graspd"),
    ],
)
def test_what_has_the_port_is_told(tmp_path: Path, status: int, body: str, ok: bool, told: str) -> None:
    with answering(status, body) as taken:
        found = port(Settings(data_dir=tmp_path, port=taken))
    assert found.ok is ok
    assert told in found.message


def test_a_free_port_is_good_and_an_address_of_others_bad(tmp_path: Path) -> None:
    (free,) = free_ports(1)
    assert port(Settings(data_dir=tmp_path, port=free)).condition is Condition.GOOD
    found = port(Settings(data_dir=tmp_path, host="192.0.2.1", port=0))
    assert not found.ok
    assert "GRASPD_HOST" in found.fix


def test_the_service_of_the_data_folder_is_asked_at_its_address(tmp_path: Path) -> None:
    (gone,) = free_ports(1)
    record_address(tmp_path, f"http://127.0.0.1:{gone}")
    found = port(Settings(data_dir=tmp_path))
    assert not found.ok
    assert f"no API answers at http://127.0.0.1:{gone}" in found.message
    with answering(200, READY) as taken:
        record_address(tmp_path, f"http://127.0.0.1:{taken}")
        assert port(Settings(data_dir=tmp_path)).condition is Condition.GOOD
