"""A private Redis, and the parts of a service with and without it."""

import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from graspd.service.model.errors import QueueUnavailable
from graspd.service.pipeline.backends import Services
from graspd.service.queue.connection import connect, redis_url
from graspd.service.queue.rq_queue import RqQueue
from graspd.service.run.embedded import server_command
from graspd.service.settings import Settings
from graspd.service.store.store import Store, open_store
from tests.fakes import add_assets
from tests.indexes import EmptySchemas, open_services
from tests.servers import PostgresServer
from tests.waiting import until

#: The kinds of databases that an index may be in.
DATABASES = ["sqlite", pytest.param("postgres", marks=pytest.mark.postgres)]


@pytest.fixture(scope="session")
def redis_settings(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Settings]:
    """Settings of a data folder with the Redis of `graspd up`, which belongs to this test process."""
    settings = Settings(data_dir=tmp_path_factory.mktemp("redis"))
    with subprocess.Popen(server_command(settings), stdout=subprocess.DEVNULL) as process:
        queue = RqQueue(connect(redis_url(settings), patience=0))
        wait_for_redis(queue)
        queue.close()
        yield settings
        process.terminate()


@pytest.fixture(scope="session")
def redis_server(redis_settings: Settings) -> str:
    return redis_url(redis_settings)


def wait_for_redis(queue: RqQueue) -> None:
    until(lambda: is_up(queue), "Redis answers")


def is_up(queue: RqQueue) -> bool:
    try:
        return queue.ping() >= 0
    except QueueUnavailable:
        return False


@pytest.fixture
def rq_queue(redis_server: str) -> Iterator[RqQueue]:
    queue = RqQueue(connect(redis_server))
    queue.connection.flushdb()
    yield queue
    queue.close()


@pytest.fixture(scope="session")
def empty_schemas(postgres_server: PostgresServer) -> Iterator[EmptySchemas]:
    """Schemas of the PostgreSQL of this test process that tests lend one after another."""
    made = EmptySchemas(postgres_server)
    yield made
    made.close()


@pytest.fixture(params=DATABASES)
def index_url(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[str]:
    if request.param == "postgres":
        schemas: EmptySchemas = request.getfixturevalue("empty_schemas")
        with schemas.lent() as url:
            yield url
    else:
        yield f"sqlite:///{tmp_path / 'index.sqlite'}"


def service(folder: Path, store: Store | None = None, queue: RqQueue | None = None, **said: Any) -> Iterator[Services]:
    """A service without processes, with a hand `gripper` and an object `ball`; each batch is a task."""
    made = open_services(Settings(data_dir=folder, **{"retry_backoff_s": 0.0, "task_s": 0.0, **said}), store, queue)
    add_assets(made)
    yield made
    made.close()


@pytest.fixture
def services(tmp_path: Path) -> Iterator[Services]:
    """A service with a store in memory and an index in SQLite."""
    yield from service(tmp_path, open_store("memory://"))
