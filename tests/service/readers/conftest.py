"""What is read: the shards of a finished job in a store, and pictures in closed form in a folder."""

from pathlib import Path

import pytest

from graspd.service.pipeline.backends import Services
from graspd.service.readers import Shards, open_shards
from tests.api import factories
from tests.service.readers import box_scenes

GRASPS = 40


def job_in(services: Services) -> str:
    """Id of a finished job of two batches with scenes and pictures."""
    factories.add_builtins(services)
    record = factories.add_job(services, grasps=GRASPS, scenes=2, views=2, width=24, height=16)
    factories.finish_all(services, record)
    return record.id


@pytest.fixture
def shards(services: Services, tmp_path: Path) -> Shards:
    return open_shards(services.store, job=job_in(services), cache=tmp_path / "cache")


@pytest.fixture(scope="session")
def box(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return box_scenes.write(tmp_path_factory.mktemp("box"))
