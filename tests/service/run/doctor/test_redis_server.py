"""Redis as the doctor sees it: a real server, mistuned in each way that loses tasks."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from redis import Redis

from graspd.service.queue.connection import connect, redis_url
from graspd.service.queue.rq_queue import RqQueue
from graspd.service.run.doctor.backends import persistence, redis
from graspd.service.run.doctor.checks import Condition
from graspd.service.run.embedded import find_server, server_command
from graspd.service.settings import Settings
from tests.servers import free_ports
from tests.service.conftest import wait_for_redis


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Settings]:
    """The Redis of `graspd up`, of these tests alone."""
    settings = Settings(data_dir=tmp_path_factory.mktemp("own"))
    with subprocess.Popen(server_command(settings), stdout=subprocess.DEVNULL) as process:
        queue = RqQueue(connect(redis_url(settings), patience=0))
        wait_for_redis(queue)
        queue.close()
        yield settings
        process.terminate()


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is slow is the machine that the tests run on."""
    monkeypatch.setattr("graspd.service.run.doctor.backends._SLOW_REDIS_S", 60.0)


@pytest.fixture
def client(own: Settings) -> Iterator[Redis]:
    """A client whose changes of the configuration are taken back."""
    client = connect(redis_url(own))
    before = {name: client.config_get(name)[name] for name in ("maxmemory", "maxmemory-policy", "appendonly")}
    yield client
    client.replicaof("no", "one")
    for name, value in before.items():
        client.config_set(name, value)
    client.close()


def test_the_redis_of_graspd_up_is_good_and_keeps_its_tasks(own: Settings, client: Redis) -> None:
    found = redis(own)
    assert found.condition is Condition.GOOD, found
    assert "Redis" in found.message
    assert str(own.data_dir) in found.message
    assert persistence(own).condition is Condition.GOOD
    assert client.keys("graspd:doctor:*") == [], "a probe was left behind"


def test_a_redis_never_started_is_skipped_and_a_lost_one_bad(tmp_path: Path) -> None:
    found = redis(Settings(data_dir=tmp_path))
    assert found.condition is Condition.SKIPPED and "graspd up" in found.message
    away = Settings(data_dir=tmp_path, redis_url=(url := f"redis://127.0.0.1:{free_ports(1)[0]}/0"))
    found = redis(away)
    assert not found.ok and url in found.message
    assert persistence(away).condition is Condition.SKIPPED


def test_a_policy_that_evicts_is_bad_once_memory_is_bounded(own: Settings, client: Redis) -> None:
    client.config_set("maxmemory-policy", "allkeys-lru")
    assert redis(own).condition is Condition.GOOD, "without a bound nothing is evicted"
    client.config_set("maxmemory", "64mb")
    found = redis(own)
    assert not found.ok
    assert "allkeys-lru" in found.message
    assert "maxmemory-policy noeviction" in found.fix


def test_a_full_memory_is_bad(own: Settings, client: Redis) -> None:
    client.config_set("maxmemory", str(client.info("memory")["used_memory"]))
    found = redis(own)
    assert not found.ok
    assert "MiB are used" in found.message


def test_a_replica_is_bad(own: Settings, client: Redis) -> None:
    client.replicaof("127.0.0.1", str(free_ports(1)[0]))
    found = redis(own)
    assert not found.ok
    assert "primary" in found.fix


def test_without_a_log_of_writes_a_crash_costs_a_pause(own: Settings, client: Redis) -> None:
    client.config_set("appendonly", "no")
    found = persistence(own)
    assert (found.ok, found.condition) == (True, Condition.WARNING)
    assert "appendonly yes" in found.fix


def test_a_password_that_is_missing_is_named_and_never_shown(tmp_path: Path) -> None:
    (port,) = free_ports(1)
    options = f"--port {port} --bind 127.0.0.1 --requirepass s3cret --save".split()
    with subprocess.Popen([find_server()[0], *options, ""], stdout=subprocess.DEVNULL, cwd=tmp_path) as process:
        right = f"redis://:s3cret@127.0.0.1:{port}/0"
        queue = RqQueue(connect(right, patience=0))
        wait_for_redis(queue)
        queue.close()
        found = [redis(Settings(data_dir=tmp_path, redis_url=url)) for url in (right, f"redis://127.0.0.1:{port}/0")]
        process.terminate()
    assert [one.condition for one in found] == [Condition.GOOD, Condition.BAD]
    assert "redis://:PASSWORD@" in found[1].fix
    assert "s3cret" not in str(found)
