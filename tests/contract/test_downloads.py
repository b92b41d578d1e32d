"""Files of a store behind a network: handed out by the store itself where users reach it, else through the API."""

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest
from starlette.testclient import TestClient

from graspd.api.app import create_app
from graspd.service.pipeline.backends import Services
from graspd.service.settings import Settings
from graspd.service.store.store import open_store
from tests.api.factories import add_builtins, add_job, finish_all
from tests.indexes import empty_index
from tests.memory_queue import MemoryQueue
from tests.servers import S3Server

pytestmark = pytest.mark.s3


@contextmanager
def front_door(folder: Path, url: str, endpoint: str | None) -> Iterator[tuple[TestClient, str, str]]:
    """An API on the S3 store; a shard's address and SHA-256."""
    settings = Settings(data_dir=folder, store_url=url, store_public_endpoint=endpoint)
    store = open_store(url, public_endpoint=endpoint)
    services = Services(settings, store, empty_index(settings.resolved_index_url), MemoryQueue())
    add_builtins(services)
    shard = finish_all(services, add_job(services))[0]
    client = TestClient(create_app(settings, services), base_url="http://127.0.0.1:8000")
    with client:
        yield client, f"/v1/shards/{shard.shard_id}/file", shard.sha256
    services.close()


def test_the_store_hands_files_out_where_users_reach_it(tmp_path: Path, s3_url: str, s3_server: S3Server) -> None:
    with front_door(tmp_path, s3_url, s3_server.environment["AWS_ENDPOINT_URL"]) as (http, path, sha256):
        answer = http.get(path, follow_redirects=False)
        assert answer.status_code == 307
        data = httpx.get(answer.headers["location"], trust_env=False, timeout=60).content
        assert hashlib.sha256(data).hexdigest() == sha256


def test_files_go_through_the_api_where_stores_are_not_reached(tmp_path: Path, s3_url: str) -> None:
    with front_door(tmp_path, s3_url, None) as (http, path, sha256):
        whole = http.get(path, follow_redirects=False)
        assert (whole.status_code, hashlib.sha256(whole.content).hexdigest()) == (200, sha256)
        part = http.get(path, headers={"Range": "bytes=5-9"})
        assert (part.status_code, part.content) == (206, whole.content[5:10])
