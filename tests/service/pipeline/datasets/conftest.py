"""A service without processes with two hands and three objects, on SQLite and on PostgreSQL."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from pydantic import SecretStr

from graspd.service.pipeline.backends import Services
from graspd.service.store.store import open_store
from tests.service.conftest import service
from tests.service.pipeline.datasets.makers import add_asset


@pytest.fixture
def either(index_url: str, tmp_path: Path) -> Iterator[Services]:
    yield from _service(tmp_path, index_url=SecretStr(index_url))


@pytest.fixture
def services(tmp_path: Path) -> Iterator[Services]:
    yield from _service(tmp_path)


def _service(folder: Path, **said: SecretStr) -> Iterator[Services]:
    for made in service(folder, open_store("memory://"), **said):
        for kind, name in (("hand", "claw"), ("object", "cube"), ("object", "cone")):
            add_asset(made, kind, name)
        yield made
