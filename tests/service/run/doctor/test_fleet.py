"""Redis, controller, workers, port and clocks as the doctor sees them, on real servers and real sockets."""

import json
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import pytest
from redis import Redis

from graspd.service.model.clock import timestamp
from graspd.service.model.states import Priority, Stage
from graspd.service.model.version import PACKAGE_VERSION
from graspd.service.pipeline.leading import PART
from graspd.service.queue.connection import connect, redis_url
from graspd.service.queue.rq_queue import WORKERS, RqQueue, worker_key
from graspd.service.run.address import record_address
from graspd.service.run.doctor.backends import check_persistence, check_redis
from graspd.service.run.doctor.checks import Condition
from graspd.service.run.doctor.fleet import check_clocks, check_controller, check_port, check_workers
from graspd.service.run.embedded import find_server
from graspd.service.settings import Settings
from tests.fakes import beat_of
from tests.servers import free_ports
from tests.service.conftest import wait_for_redis
from tests.service.queue.test_queue import task


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("graspd.service.run.doctor.backends._SLOW_REDIS_S", 60.0)


@pytest.fixture
def client(redis_settings: Settings) -> Iterator[Redis]:
    """A client whose changes of the configuration are taken back."""
    client = connect(redis_url(redis_settings))
    before = {name: client.config_get(name)[name] for name in ("maxmemory", "maxmemory-policy", "appendonly")}
    yield client
    client.replicaof("no", "one")
    for name, value in before.items():
        client.config_set(name, value)
    client.close()


def test_the_redis_of_graspd_up_is_good_and_keeps_its_tasks(redis_settings: Settings, client: Redis) -> None:
    found = check_redis(redis_settings)
    assert found.condition is Condition.GOOD, found
    assert "Redis" in found.message and str(redis_settings.data_dir) in found.message
    assert check_persistence(redis_settings).condition is Condition.GOOD
    assert client.keys("graspd:doctor:*") == [], "a probe was left behind"


def test_a_redis_never_started_is_skipped_and_a_lost_one_bad(tmp_path: Path) -> None:
    found = check_redis(Settings(data_dir=tmp_path))
    assert found.condition is Condition.SKIPPED and "graspd up" in found.message
    away = Settings(data_dir=tmp_path, redis_url=(url := f"redis://127.0.0.1:{free_ports(1)[0]}/0"))
    found = check_redis(away)
    assert not found.ok and url in found.message
    assert check_persistence(away).condition is Condition.SKIPPED


def test_a_policy_that_evicts_is_bad_once_memory_is_bounded(redis_settings: Settings, client: Redis) -> None:
    client.config_set("maxmemory-policy", "allkeys-lru")
    assert check_redis(redis_settings).condition is Condition.GOOD, "without a bound nothing is evicted"
    client.config_set("maxmemory", "64mb")
    found = check_redis(redis_settings)
    assert not found.ok and "allkeys-lru" in found.message and "maxmemory-policy noeviction" in found.fix


def test_a_replica_and_a_full_memory_are_bad(redis_settings: Settings, client: Redis) -> None:
    client.replicaof("127.0.0.1", str(free_ports(1)[0]))
    found = check_redis(redis_settings)
    assert not found.ok and "primary" in found.fix
    client.replicaof("NO", "ONE")
    client.config_set("maxmemory", str(client.info("memory")["used_memory"]))
    found = check_redis(redis_settings)
    assert not found.ok and "MiB are used" in found.message


def test_a_redis_that_returns_another_value_is_bad(redis_settings: Settings, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Redis, "get", lambda *_: b"another")
    found = check_redis(redis_settings)
    assert not found.ok and "changed between write and read" in found.message


def test_without_a_log_of_writes_a_crash_costs_a_pause(redis_settings: Settings, client: Redis) -> None:
    client.config_set("appendonly", "no")
    found = check_persistence(redis_settings)
    assert (found.ok, found.condition) == (True, Condition.WARNING) and "appendonly yes" in found.fix


def test_a_password_that_is_missing_is_named_and_never_shown(tmp_path: Path) -> None:
    (port,) = free_ports(1)
    options = f"--port {port} --bind 127.0.0.1 --requirepass s3cret --save".split()
    with subprocess.Popen([find_server()[0], *options, ""], stdout=subprocess.DEVNULL, cwd=tmp_path) as process:
        right = f"redis://:s3cret@127.0.0.1:{port}/0"
        queue = RqQueue(connect(right, patience=0))
        wait_for_redis(queue)
        queue.close()
        found = [
            check_redis(Settings(data_dir=tmp_path, redis_url=url)) for url in (right, f"redis://127.0.0.1:{port}/0")
        ]
        process.terminate()
    assert [one.condition for one in found] == [Condition.GOOD, Condition.BAD]
    assert "redis://:PASSWORD@" in found[1].fix and "s3cret" not in str(found)


@pytest.fixture
def settings(rq_queue: RqQueue, redis_server: str, tmp_path: Path) -> Settings:
    return Settings(data_dir=tmp_path, redis_url=redis_server)


def present(queue: RqQueue, name: str = "w", **facts: Any) -> None:
    beat = beat_of(name, **{"host": "node1", "version": PACKAGE_VERSION, **facts})
    queue.connection.sadd(WORKERS, name)
    queue.connection.set(worker_key(name), json.dumps(asdict(beat)), ex=60)


def test_a_controller_that_lives_and_one_that_does_not(settings: Settings, rq_queue: RqQueue) -> None:
    found = check_controller(settings)
    assert not found.ok and found.fix == "graspd controller"
    rq_queue.announce(PART, 60)
    assert check_controller(settings).condition is Condition.GOOD


def test_workers_that_fit_are_counted(settings: Settings, rq_queue: RqQueue) -> None:
    assert check_workers(settings).condition is Condition.WARNING, "none, and nothing waits"
    present(rq_queue)
    present(rq_queue, "v", state="busy", host="node2")
    found = check_workers(settings)
    assert found.condition is Condition.GOOD and "1 busy, 1 idle, on 2 machines" in found.message


@pytest.mark.parametrize(
    ("facts", "told", "fix"),
    [
        ({"version": "0.0.9"}, "0.0.9 on node1", f"install graspd {PACKAGE_VERSION}"),
        ({"state": "quarantined", "reason": "no driver"}, "no driver", "on node1: graspd doctor"),
    ],
)
def test_unfit_workers_are_bad(settings: Settings, rq_queue: RqQueue, facts: Any, told: str, fix: str) -> None:
    present(rq_queue)
    present(rq_queue, "ill", **facts)
    found = check_workers(settings)
    assert not found.ok and told in found.message and fix in found.fix


def test_tasks_of_a_stage_that_nobody_serves_are_bad(settings: Settings, rq_queue: RqQueue) -> None:
    present(rq_queue, stages=(Stage.INGEST, Stage.SCENE))
    rq_queue.enqueue([task("a", stage=Stage.RENDER), task("b", stage=Stage.SCENE)], Priority.BULK)
    found = check_workers(settings)
    assert not found.ok and "1 tasks wait, and no worker serves render" in found.message
    assert found.fix == "graspd worker --stages render"


def test_where_nothing_runs_nothing_is_asked(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path)
    assert {look(settings).condition for look in (check_controller, check_workers, check_clocks)} == {Condition.SKIPPED}


@pytest.mark.parametrize(
    ("ahead_s", "condition"),
    [(-60.0, Condition.WARNING), (60.0, Condition.WARNING), (3600.0, Condition.BAD), (-3.0, Condition.GOOD)],
)
def test_a_wrong_clock_is_named(settings: Settings, rq_queue: RqQueue, ahead_s: float, condition: Condition) -> None:
    present(rq_queue, seen=timestamp(-ahead_s))
    found = check_clocks(settings)
    assert found.condition is condition, found
    assert ("Redis" if condition is Condition.GOOD else "node1") in found.message


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
        (200, "<html>a wiki</html>", False, "is not graspd"),
        (404, "{}", False, "is not graspd"),
    ],
)
def test_what_has_the_port_is_told(tmp_path: Path, status: int, body: str, ok: bool, told: str) -> None:
    with answering(status, body) as taken:
        found = check_port(Settings(data_dir=tmp_path, port=taken))
    assert found.ok is ok and told in found.message


def test_the_service_of_the_data_folder_is_asked_at_its_address(tmp_path: Path) -> None:
    (gone,) = free_ports(1)
    assert check_port(Settings(data_dir=tmp_path, port=gone)).condition is Condition.SKIPPED, "none is expected there"
    record_address(tmp_path, f"http://127.0.0.1:{gone}")
    found = check_port(Settings(data_dir=tmp_path))
    assert not found.ok and f"no API answers at http://127.0.0.1:{gone}" in found.message
    with answering(200, READY) as taken:
        record_address(tmp_path, f"http://127.0.0.1:{taken}")
        assert check_port(Settings(data_dir=tmp_path)).condition is Condition.GOOD
