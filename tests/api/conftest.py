"""The application over a file store, an SQLite index and the queue's twin; no network, no Redis."""

import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from datetime import datetime, tzinfo
from pathlib import Path
from typing import Any, Self

import pytest
from fastapi import FastAPI
from pydantic import SecretStr
from starlette.testclient import TestClient

from graspd.api.access.keys import KeyFile
from graspd.api.app import create_app
from graspd.service.pipeline.backends import Services
from graspd.service.queue.rq_queue import RqQueue
from graspd.service.settings import Settings
from tests.api.factories import add_builtins
from tests.indexes import open_services
from tests.service.conftest import redis_server, redis_settings, rq_queue

__all__ = ["redis_server", "redis_settings", "rq_queue"]
TODAY = "2026-11-20"
BASE_URL = "http://127.0.0.1:8000"


@pytest.fixture(scope="session")
def furnished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data folder with the built-in hands and objects in store and index; each test gets a copy."""
    folder = tmp_path_factory.mktemp("furnished") / "data"
    opened = open_services(Settings(data_dir=folder))
    add_builtins(opened)
    opened.close()
    return folder


class _Noon(datetime):
    @classmethod
    def now(cls, tz: tzinfo | None = None) -> Self:
        return cls.fromisoformat(f"{TODAY}T12:00:00+00:00")


@pytest.fixture
def noon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("graspd.api.access.quotas.datetime", _Noon)


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(data_dir=tmp_path / "data")


@pytest.fixture
def services(settings: Settings, furnished: Path) -> Iterator[Services]:
    shutil.copytree(furnished, settings.data_dir, dirs_exist_ok=True)
    opened = open_services(settings)
    yield opened
    opened.close()


@pytest.fixture
def app(settings: Settings, services: Services) -> FastAPI:
    return create_app(settings, services)


@pytest.fixture
def http(app: FastAPI) -> Iterator[TestClient]:
    with TestClient(app, base_url=BASE_URL, raise_server_exceptions=False) as client:
        yield client


@pytest.fixture
def keys(settings: Settings) -> KeyFile:
    return KeyFile(settings.resolved_keys_file)


@pytest.fixture
def make_twins(
    settings: Settings, services: Services, redis_server: str, rq_queue: RqQueue, noon: None
) -> Iterator[Callable[..., list[TestClient]]]:
    with ExitStack() as clients:

        def make(**changes: Any) -> list[TestClient]:
            wanted = settings.model_copy(update={"redis_url": SecretStr(redis_server), **changes})
            shared = Services(wanted, services.store, services.index, services.queue)
            apps = [create_app(wanted, shared) for _ in range(2)]
            return [clients.enter_context(TestClient(app, base_url=BASE_URL)) for app in apps]

        yield make
