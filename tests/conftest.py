"""Fixtures for all tests."""

import gc
import os
import sys
import uuid
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from tests.servers import MissingServer, PostgresServer, S3Server

# The same examples in each run, however long they take: a test that passes on one machine passes on another. `slow`
# tests draw fresh ones.
settings.register_profile(
    "graspd", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large]
)
settings.load_profile("graspd")

#: The processes of tests share the cores: a second thread of a small matrix product only waits, and computes to do so.
#: NumPy, which is not imported yet, reads it.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Hundreds of processes of tests import the same modules: where Python may keep none, each compiles them anew.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# What is imported while tests are collected is no garbage.
gc.disable()


def pytest_collection_finish() -> None:
    gc.enable()
    gc.collect()
    gc.freeze()


REPOSITORY = Path(__file__).resolve().parent.parent
#: Folders of the product.
PACKAGES = ("graspd", "service", "worker", "api", "baselines", "exchange", "studies")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real hands, YCB objects, published grasps and bad inputs that stands beside the repository."""
    folder = REPOSITORY.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("the reference data (../shared/data) is not beside this checkout")
    return folder


@pytest.fixture(scope="session")
def s3_server() -> Iterator[S3Server]:
    try:
        server = S3Server()
    except MissingServer as missing:
        pytest.skip(str(missing))
    with server:
        yield server


@pytest.fixture(scope="session")
def postgres_server() -> Iterator[PostgresServer]:
    try:
        with PostgresServer() as server:
            yield server
    except MissingServer as missing:
        pytest.skip(str(missing))


@pytest.fixture
def s3_url(s3_server: S3Server, monkeypatch: pytest.MonkeyPatch) -> str:
    """URL of an empty place in the S3 store, whose credentials are in the environment."""
    for name, value in s3_server.environment.items():
        monkeypatch.setenv(name, value)
    return f"{s3_server.url}/{uuid.uuid4().hex}"
