"""The index as the doctor sees it: real files and a real PostgreSQL, which it never migrates, moves or fills."""

import sqlite3
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from graspd.service.index.database import REVISION
from graspd.service.index.index import Index
from graspd.service.index.notes import Damage
from graspd.service.index.rebuild import rebuild
from graspd.service.model import names
from graspd.service.pipeline import job_actions
from graspd.service.pipeline.backends import Services
from graspd.service.run.doctor import backends
from graspd.service.run.doctor.checks import Condition, Finding
from graspd.service.settings import Settings
from graspd.service.store.store import open_store
from tests.fakes import finish, request
from tests.memory_queue import MemoryQueue
from tests.servers import PostgresServer, free_ports
from tests.service.conftest import service
from tests.service.index.test_index import fail

Look = Callable[[], Finding]


@pytest.fixture
def kept(tmp_path: Path) -> Iterator[Services]:
    for services in service(tmp_path):
        finish(services, job_actions.submit(services, request(grasps=64))[0].id)
        services.index.notes.set_complete()
        yield services


@pytest.fixture(params=["rows", "names"])
def look(request: pytest.FixtureRequest, kept: Services, monkeypatch: pytest.MonkeyPatch) -> Look:
    if request.param == "names":
        monkeypatch.setattr(backends, "_ALL_SHARDS", 0)
    return lambda: backends.compare_index_with_store(kept.settings, settles_s=0.0)


def shard_of(services: Services) -> Path:
    return next((services.settings.data_dir / "store" / names.SHARDS / "base").glob("*.json"))


def test_an_index_that_is_what_the_store_says_is_good(kept: Services, look: Look) -> None:
    found = look()
    assert found.condition is Condition.GOOD, found
    assert backends.check_index(kept.settings).condition is Condition.GOOD


def remove_row(services: Services) -> None:
    with services.index.database.write_transaction() as connection:
        connection.exec_driver_sql(f"DELETE FROM shards WHERE id = '{shard_of(services).stem}'")


@pytest.mark.parametrize(
    ("harm", "words"),
    [(lambda services: shard_of(services).unlink(), "not in the store"), (remove_row, "not in the index")],
)
def test_a_manifest_or_row_that_is_gone_is_bad(kept: Services, look: Look, harm: Any, words: str) -> None:
    shard = shard_of(kept).stem
    harm(kept)
    found = look()
    assert not found.ok and shard in found.message and words in found.message and "index rebuild" in found.fix


def test_a_row_that_differs_is_bad(kept: Services) -> None:
    with kept.index.database.write_transaction() as connection:
        connection.exec_driver_sql("UPDATE shards SET valid = valid + 1")
    found = backends.compare_index_with_store(kept.settings, settles_s=0.0)
    assert not found.ok and shard_of(kept).stem in found.message and "in the store " in found.message


def test_what_is_on_its_way_in_is_no_difference(kept: Services, look: Look, monkeypatch: pytest.MonkeyPatch) -> None:
    key = shard_of(kept)
    data = key.read_bytes()
    key.unlink()
    monkeypatch.setattr(time, "sleep", lambda seconds: key.write_bytes(data))
    assert look().condition is Condition.GOOD


def test_known_damage_is_told_with_its_mend(kept: Services) -> None:
    assert backends.check_store_damage(kept.settings).condition is Condition.GOOD
    kept.index.damage.update([Damage("shards/base/x.h5", "has another checksum", "x")])
    found = backends.check_store_damage(kept.settings)
    assert not found.ok and "shards/base/x.h5" in found.message
    assert found.fix == "graspd admin store verify --repair"


def test_where_there_is_no_index_none_is_made(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path)
    found = [
        backends.check_index(settings),
        backends.compare_index_with_store(settings),
        backends.check_store_damage(settings),
    ]
    assert {one.condition for one in found} == {Condition.SKIPPED}
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("at", "harm"), [(0, b"no database" * 1000), (36, b"\0\0\0\7")], ids=["all", "free pages"])
def test_a_damaged_file_is_bad_and_left_where_it_is(kept: Services, at: int, harm: bytes) -> None:
    kept.index.close()
    file = kept.settings.data_dir / "index.sqlite"
    for beside in kept.settings.data_dir.glob("index.sqlite-*"):
        beside.unlink()
    with file.open("r+b") as opened:
        opened.seek(at)
        opened.write(harm)
    damaged = file.read_bytes()
    found = backends.check_index(kept.settings)
    assert not found.ok and "graspd admin index rebuild" in found.fix
    assert backends.compare_index_with_store(kept.settings).condition is Condition.SKIPPED
    assert file.read_bytes() == damaged


@pytest.mark.parametrize("revision", [f"{int(REVISION) - 1:04}", "9999"])
def test_tables_of_another_version_are_bad_and_left_as_they_are(kept: Services, revision: str) -> None:
    with kept.index.database.write_transaction() as connection:
        connection.exec_driver_sql(f"UPDATE alembic_version SET version_num = '{revision}'")
    kept.index.close()
    found = backends.check_index(kept.settings)
    assert not found.ok and "graspd admin index rebuild" in found.fix
    assert backends.compare_index_with_store(kept.settings).condition is Condition.SKIPPED
    with sqlite3.connect(kept.settings.data_dir / "index.sqlite") as connection:
        assert connection.execute("SELECT version_num FROM alembic_version").fetchone() == (revision,)


@pytest.mark.postgres
def test_a_postgresql_without_tables_and_with_them(tmp_path: Path, postgres_server: PostgresServer) -> None:
    settings = Settings(data_dir=tmp_path, index_url=postgres_server.database())
    found = backends.check_index(settings)
    assert found.condition is Condition.WARNING, found
    assert "revision none" in found.message
    Index(settings.resolved_index_url).close()
    found = backends.check_index(settings)
    assert found.condition is Condition.GOOD, found
    assert postgres_server._password not in str(found)


@pytest.mark.postgres
def test_a_postgresql_that_is_away_or_refuses_is_bad(tmp_path: Path, postgres_server: PostgresServer) -> None:
    away = f"postgresql+psycopg://graspd:hidden@127.0.0.1:{free_ports(1)[0]}/graspd"
    stranger = f"postgresql+psycopg://graspd:hidden@127.0.0.1:{postgres_server.port}/postgres"
    for url in (away, stranger):
        found = backends.check_index(Settings(data_dir=tmp_path, index_url=url))
        assert not found.ok and "GRASPD_INDEX_URL" in found.fix and "hidden" not in str(found)


@pytest.mark.postgres
def test_an_index_in_postgresql_is_compared_too(kept: Services, postgres_server: PostgresServer) -> None:
    settings = Settings(data_dir=kept.settings.data_dir, index_url=postgres_server.database())
    index = Index(settings.resolved_index_url)
    rebuild(index, kept.store)
    assert backends.compare_index_with_store(settings, settles_s=0.0).condition is Condition.GOOD
    job = index.jobs.page(limit=1).items[0].id
    fail(Services(settings, open_store("memory://"), index, MemoryQueue()), job, 0, 1, last=False)
    index.close()
    found = backends.compare_index_with_store(settings, settles_s=0.0)
    assert not found.ok and "attempts" in found.message
