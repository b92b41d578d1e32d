"""A second service is refused by every command that would work for it; a data folder may have any name."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from graspd.service.index.index import Index
from graspd.service.model.errors import InputError
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.identity import identify
from graspd.service.queue.rq_queue import RqQueue
from graspd.service.run.doctor.backends import check_index_identity
from graspd.service.run.doctor.checks import Condition
from graspd.service.run.supervisor import Supervisor
from graspd.service.settings import Settings
from graspd.service.store.store import open_store
from tests.indexes import empty_index
from tests.shell import completed
from tests.waiting import PATIENCE_S

COMMANDS = [["up", "--workers", "0", "--port", "0"], ["api", "--port", "0"], ["controller"], ["worker"]]


@pytest.fixture
def first(tmp_path: Path, rq_queue: RqQueue, redis_server: str) -> Iterator[Services]:
    settings = Settings(data_dir=tmp_path / "first", redis_url=redis_server)
    empty_index(settings.resolved_index_url).close()
    made = Services.open(settings)
    identify(made)
    yield made
    made.close()


def run(command: list[str], folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    variables = {**os.environ, "GRASPD_DATA_DIR": str(folder), "GRASPD_LOG_LEVEL": "ERROR", **environment}
    return completed([sys.executable, "-m", "graspd", *command], env=variables)


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_a_command_of_a_second_service_on_a_redis_is_refused(
    command: list[str], first: Services, redis_server: str, tmp_path: Path
) -> None:
    done = run(command, tmp_path / "second", GRASPD_REDIS_URL=redis_server)
    said = done.stderr.splitlines()[-1]
    assert (done.returncode, said.split(";")[0]) == (1, "graspd: this Redis belongs to another graspd service")
    assert "Traceback" not in done.stderr


def test_the_doctor_says_so(first: Services, redis_server: str, tmp_path: Path) -> None:
    (tmp_path / "second" / "store").mkdir(parents=True)
    second = Settings(data_dir=tmp_path / "second", redis_url=redis_server)
    assert check_index_identity(first.settings).condition is Condition.GOOD
    assert check_index_identity(second).condition is Condition.BAD


def test_another_number_of_database_is_another_redis(first: Services, redis_server: str, tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path / "second", redis_url=f"{redis_server}?db=1")
    empty_index(settings.resolved_index_url).close()
    second = Services.open(settings)
    second.queue.connection.flushdb()
    assert identify(second) != first.queue.service_id()
    second.close()


NAMES = "100% a%20b a#b what? größe q'u\"o\\te a&b=c;d [1] a:b@c {x} ~ $HOME"


@pytest.mark.parametrize("name", [*NAMES.split(), "a b", "a\nb"])
def test_store_and_index_lie_in_the_folder_and_nothing_beside_it(name: str, tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path / name)
    store = open_store(settings.resolved_store_url)
    store.put("jobs/one/job.json", b"{}")
    assert [(entry.key, store.get(entry.key)) for entry in store.list("jobs")] == [("jobs/one/job.json", b"{}")]
    assert (settings.data_dir / "store" / "jobs" / "one" / "job.json").exists()
    index = Index(settings.resolved_index_url)
    index.notes.set_service_id("one")
    index.close()
    again = Index(settings.resolved_index_url)
    assert again.notes.service_id() == "one"
    again.close()
    assert (settings.data_dir / "index.sqlite").exists()
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_a_whole_service_gets_ready_in_an_odd_folder(tmp_path: Path) -> None:
    name = "100% #1? ü a\nb 'c' \"d\" \\e " + "x" * 60
    settings = Settings(data_dir=tmp_path / name, port=0)
    with Supervisor(settings, workers=0) as supervisor:
        assert supervisor.wait_ready(PATIENCE_S)
        services = Services.open(supervisor.settings)
        assert services.queue.service_id() == services.index.notes.service_id()
        services.close()
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("end", ["a?b", "a#b", "a\nb", "a\tb", "a?", "a#"])
def test_a_store_url_that_would_be_cut_off_is_refused(end: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="%3F"):
        open_store(f"file://{tmp_path}/{end}")
    assert not list(tmp_path.iterdir())
