"""What is read: the shards of a finished job in a store, and pictures in closed form in a folder."""

import hashlib
from collections.abc import Iterable
from pathlib import Path

import pytest

from graspd.service.model.names import dataset_snapshot_key
from graspd.service.model.records import Snapshot
from graspd.service.pipeline.backends import Services
from graspd.service.readers import Shards, open_shards
from graspd.service.readers.files import ShardFile
from graspd.service.store.records import put_record
from graspd.service.store.store import Store
from tests.api import factories
from tests.service.readers import box_scenes

GRASPS = 40


def job_in(services: Services) -> str:
    """Id of a finished job of two batches with scenes and pictures."""
    factories.add_builtins(services)
    record = factories.add_job(services, grasps=GRASPS, scenes=2, views=2, width=24, height=16)
    factories.finish_all(services, record)
    return record.id


def put_snapshot(store: Store, dataset: str, files: Iterable[ShardFile], *, created: str) -> None:
    digest, sums = hashlib.sha256(created.encode()).hexdigest()[:32], {"size_bytes": 1, "valid": 1}
    same = ("id", "kind", "key", "sha256", "hand", "object", "batch")
    listed = [{name: getattr(file, name) for name in same} | sums | {"count": 1} for file in files]
    of = {"dataset": dataset, "dataset_digest": "a" * 32, "digest": digest, "complete": True, "grasps": 1}
    put_record(store, dataset_snapshot_key(dataset, digest), Snapshot(**of, **sums, created=created, shards=listed))


@pytest.fixture
def shards(services: Services, tmp_path: Path) -> Shards:
    return open_shards(services.store, job=job_in(services), cache=tmp_path / "cache")


@pytest.fixture(scope="session")
def box(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return box_scenes.write(tmp_path_factory.mktemp("box"))
