"""A second service is refused by every command that would work for it, in one line and with exit code 1."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.identity import identify
from graspd.service.queue.connection import connect
from graspd.service.queue.rq_queue import RqQueue
from graspd.service.settings import Settings
from tests.indexes import empty_index

COMMANDS = [["up", "--workers", "0", "--port", "0"], ["api", "--port", "0"], ["controller"], ["worker"]]


@pytest.fixture
def first(tmp_path: Path, rq_queue: RqQueue, redis_server: str) -> Iterator[Services]:
    settings = Settings(data_dir=tmp_path / "first", redis_url=redis_server)
    empty_index(settings.resolved_index_url).close()
    made = Services.open(settings)
    identify(made)
    yield made
    made.close()


@pytest.fixture
def beside(redis_server: str) -> str:
    """URL of an empty Redis: another number of database."""
    url = f"{redis_server}?db=1"
    with closing(RqQueue(connect(url))) as queue:
        queue.connection.flushdb()
    return url


def run(command: list[str], folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    variables = {**os.environ, "GRASPD_DATA_DIR": str(folder), "GRASPD_LOG_LEVEL": "ERROR", **environment}
    return subprocess.run(
        [sys.executable, "-m", "graspd", *command], env=variables, capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_a_command_of_a_second_service_on_a_redis_is_refused(
    command: list[str], first: Services, redis_server: str, tmp_path: Path
) -> None:
    done = run(command, tmp_path / "second", GRASPD_REDIS_URL=redis_server)
    said = done.stderr.splitlines()[-1]
    assert (done.returncode, said.split(";")[0]) == (1, "graspd: this Redis belongs to another graspd service")
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("command", COMMANDS[:3], ids=" ".join)
def test_a_command_of_a_second_service_on_a_store_is_refused(
    command: list[str], first: Services, beside: str, tmp_path: Path
) -> None:
    done = run(command, tmp_path / "second", GRASPD_STORE_URL=first.store.url, GRASPD_REDIS_URL=beside)
    said = done.stderr.splitlines()[-1]
    assert (done.returncode, said.partition(" graspd service")[0]) == (
        1,
        f"graspd: the store {first.store.url} belongs to another",
    )


def test_the_doctor_says_so(first: Services, redis_server: str, tmp_path: Path) -> None:
    Settings(data_dir=tmp_path / "second").data_dir.joinpath("store").mkdir(parents=True)
    doctor = ["doctor", "--only", "identity"]
    assert run(doctor, first.settings.data_dir, GRASPD_REDIS_URL=redis_server).returncode == 0
    done = run(doctor, tmp_path / "second", GRASPD_REDIS_URL=redis_server)
    assert done.returncode == 1
    assert "bad      identity" in done.stdout


def test_another_number_of_database_is_another_redis(first: Services, beside: str, tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path / "second", redis_url=beside)
    empty_index(settings.resolved_index_url).close()
    second = Services.open(settings)
    assert identify(second) != first.queue.service()
    second.close()
