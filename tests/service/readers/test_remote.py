"""Reading a job from S3 by way of the local cache."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from graspd.service.model.records import JobRecord
from graspd.service.pipeline.backends import Services
from graspd.service.readers import Grasps, Pictures, open_shards
from graspd.service.settings import Settings
from graspd.service.store.store import open_store
from tests.api import factories
from tests.indexes import empty_index
from tests.memory_queue import MemoryQueue
from tests.servers import S3Server

pytestmark = pytest.mark.s3


@pytest.fixture
def remote(tmp_path: Path, s3_url: str) -> Iterator[Services]:
    index = empty_index(f"sqlite:///{tmp_path / 'index.sqlite'}")
    made = Services(Settings(data_dir=tmp_path), open_store(s3_url), index, MemoryQueue())
    factories.add_builtins(made)
    yield made
    made.close()


@pytest.fixture
def job(remote: Services) -> JobRecord:
    record = factories.add_job(remote, grasps=40, scenes=2, views=2, width=24, height=16)
    factories.finish_all(remote, record)
    return record


def test_what_is_read_from_s3_is_what_was_written(
    remote: Services, job: JobRecord, s3_url: str, tmp_path: Path
) -> None:
    shards = open_shards(s3_url, job=job.id, cache=tmp_path / "cache")
    written = [remote.store.get(file.key) for file in shards]
    assert [shards.path(file).read_bytes() for file in shards] == written
    assert len(Grasps(shards, valid=False)) == 40 and len(Pictures(shards)) == 8


def test_what_was_read_once_needs_the_server_no_more(
    remote: Services, job: JobRecord, s3_url: str, s3_server: S3Server, tmp_path: Path
) -> None:
    shards = open_shards(s3_url, job=job.id, cache=tmp_path / "cache")
    first = Grasps(shards).arrays("grasp/hand_pose")
    s3_server.kill()
    try:
        again = Grasps(shards).arrays("grasp/hand_pose")
    finally:
        s3_server.start()
    np.testing.assert_array_equal(again["grasp/hand_pose"], first["grasp/hand_pose"])


def test_a_cache_smaller_than_the_job_still_reads_all_of_it(
    remote: Services, job: JobRecord, s3_url: str, tmp_path: Path
) -> None:
    shards = open_shards(s3_url, job=job.id, cache=tmp_path / "cache", cache_bytes=60_000)
    largest = max(len(remote.store.get(file.key)) for file in shards)
    assert sum(1 for _ in Grasps(shards, valid=False)) == 40
    held = sum(path.stat().st_size for path in (tmp_path / "cache").iterdir())
    assert held <= max(60_000, largest) < sum(len(remote.store.get(file.key)) for file in shards)
