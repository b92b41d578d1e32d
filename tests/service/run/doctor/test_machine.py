"""Machine, store and index as the doctor sees them, and checks side by side; a real PostgreSQL is never changed."""

import os
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO
from unittest.mock import Mock

import obstore
import pytest
from obstore.store import MemoryStore

from graspd.service.index.database import REVISION
from graspd.service.index.index import Index
from graspd.service.index.notes import Damage
from graspd.service.index.rebuild import rebuild
from graspd.service.model import names
from graspd.service.model.errors import StoreUnavailable
from graspd.service.pipeline import job_actions
from graspd.service.pipeline.backends import Services
from graspd.service.run.doctor import backends
from graspd.service.run.doctor.backends import check_configured_store, check_store
from graspd.service.run.doctor.checks import Check, Condition, Finding, good, run_checks
from graspd.service.run.doctor.machine import check_data_folder, check_disk, check_limits, filesystem_type
from graspd.service.settings import Settings
from graspd.service.store.store import Store, open_store
from tests.fakes import finish, request
from tests.memory_queue import MemoryQueue
from tests.servers import PostgresServer, free_ports
from tests.service.conftest import service
from tests.service.index.test_index import fail

GIB = 2**30


@pytest.mark.parametrize(
    ("free", "condition"), [(100 * GIB, Condition.GOOD), (3 * GIB, Condition.WARNING), (GIB // 2, Condition.BAD)]
)
def test_room_is_validated_by_the_fullest_disk(tmp_path: Path, free: int, condition: Condition) -> None:
    settings = Settings(data_dir=tmp_path / "data", store_url=(tmp_path / "far").as_uri())
    (tmp_path / "far").mkdir()
    found = check_disk(settings, usage=lambda folder: (0, 0, free if folder == tmp_path / "far" else 200 * GIB))
    assert found.condition is condition
    if condition is not Condition.GOOD:
        assert str(tmp_path / "far") in found.message and "GRASPD_STORE_URL" in found.fix


def test_a_data_folder_that_others_can_read_is_told(tmp_path: Path) -> None:
    tmp_path.chmod(0o755)
    found = check_data_folder(Settings(data_dir=tmp_path))
    assert found.condition is Condition.WARNING and found.fix == f"chmod 700 {tmp_path}"
    tmp_path.chmod(0o700)
    assert check_data_folder(Settings(data_dir=tmp_path)).condition is Condition.GOOD


def test_a_data_folder_on_a_network_is_told(tmp_path: Path) -> None:
    mounts = tmp_path / "mounts"
    kinds = f"/dev/sda / ext4 rw 0 0\nserver:/home {tmp_path} nfs4 rw 0 0\ntmpfs {tmp_path}/tmp tmpfs rw 0 0\n"
    mounts.write_text(kinds)
    folder = tmp_path / "data"
    found = check_data_folder(Settings(data_dir=folder), mounts=mounts)
    assert found.condition is Condition.WARNING and "nfs4" in found.message
    elsewhere = Settings(data_dir=folder, redis_url="redis://other", index_url="postgresql+psycopg://other/graspd")
    assert check_data_folder(elsewhere, mounts=mounts).condition is Condition.GOOD
    for path, kind in ((folder, "nfs4"), (tmp_path / "tmp" / "x", "tmpfs"), (Path("/etc"), "ext4")):
        assert filesystem_type(path, mounts) == kind
    assert not folder.exists()


@pytest.mark.skipif(os.getuid() == 0, reason="root may write everywhere")
def test_a_data_folder_that_cannot_be_written_is_bad(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    assert not check_data_folder(Settings(data_dir=tmp_path / "data")).ok


def test_few_files_and_little_memory_are_told() -> None:
    assert check_limits(files=4096, memory=16 * GIB).condition is Condition.GOOD
    assert "ulimit" in check_limits(files=256, memory=16 * GIB).fix
    assert "more memory" in check_limits(files=4096, memory=GIB).fix


def test_findings_come_in_order_and_one_that_hangs_is_bad() -> None:
    hold = threading.Event()

    def hang() -> Finding:
        hold.wait(30)
        return good("late")

    away = Mock(side_effect=StoreUnavailable("the store is away"))
    checks = [
        Check("hangs", hang, limit_s=0.05),
        Check("breaks", Mock(side_effect=ZeroDivisionError("by nothing"))),
        Check("away", away),
        Check("good", lambda: good("fine")),
    ]
    try:
        found = list(run_checks(checks))
    finally:
        hold.set()
    assert [one.name for one in found] == ["hangs", "breaks", "away", "good"]
    assert [one.condition for one in found] == [Condition.BAD] * 3 + [Condition.GOOD]
    assert "no answer within" in found[0].message and "ZeroDivisionError: by nothing" in found[1].message
    assert found[2].message == "the store is away"


def test_a_folder_is_good_and_nothing_is_left_in_it(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path)
    assert check_configured_store(settings).condition is Condition.GOOD
    assert not (tmp_path / "store").exists(), "a look makes no store"
    (tmp_path / "store").mkdir()
    found = check_configured_store(settings)
    assert found.condition is Condition.GOOD, found
    assert [path for path in (tmp_path / "store").rglob("*") if path.is_file()] == []


@pytest.mark.s3
def test_a_bucket_is_good_and_nothing_is_left_in_it(tmp_path: Path, s3_url: str) -> None:
    found = check_configured_store(Settings(data_dir=tmp_path, store_url=s3_url))
    assert found.ok, found
    assert "create-only writes work" in found.message
    assert list(open_store(s3_url).list("health")) == []


@pytest.mark.s3
def test_a_wrong_secret_names_its_variables(tmp_path: Path, s3_url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "of-somebody-else")
    found = check_configured_store(Settings(data_dir=tmp_path, store_url=s3_url))
    assert not found.ok and "AWS_SECRET_ACCESS_KEY" in found.fix and "of-somebody-else" not in str(found)


def test_a_store_in_memory_is_gone_with_its_process() -> None:
    assert check_store(open_store("memory://")).condition is Condition.WARNING


def overwrite(store: Store, key: str, file: IO[bytes]) -> bool:
    """As S3 servers do that know no conditional put."""
    file.seek(0)
    obstore.put(store._backend, key, file.read(), mode="overwrite")
    return True


@pytest.mark.parametrize(
    ("method", "other", "word"),
    [
        ("put_file", overwrite, "overwritten"),
        ("list", lambda *_, **__: iter(()), "missing in the list"),
        ("exists", lambda *_: True, "still there"),
    ],
)
def test_a_store_that_breaks_a_promise_is_bad(
    method: str, other: Callable[..., object], word: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Store, method, other)
    found = check_store(Store(MemoryStore(), "fake://"))
    assert not found.ok and word in found.message


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


def test_an_index_is_good_that_is_or_soon_will_be_what_the_store_says(
    kept: Services, look: Look, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = look()
    assert found.condition is Condition.GOOD, found
    assert backends.check_index(kept.settings).condition is Condition.GOOD
    key = shard_of(kept)
    data = key.read_bytes()
    key.unlink()
    monkeypatch.setattr(time, "sleep", lambda seconds: key.write_bytes(data))
    assert look().condition is Condition.GOOD


@pytest.mark.parametrize(
    ("harm", "words"),
    [
        ("", "not in the store"),
        ("DELETE FROM shards", "not in the index"),
        ("UPDATE shards SET valid=9", "in the store "),
    ],
)
def test_a_shard_that_is_gone_or_differs_is_bad(kept: Services, look: Look, harm: str, words: str) -> None:
    shard = shard_of(kept).stem
    with kept.index.database.write_transaction() as connection:
        connection.exec_driver_sql(f"{harm} WHERE id = '{shard}'") if harm else shard_of(kept).unlink()
    of_values = harm.startswith("UPDATE")  # where names alone are compared, only `full` sees it
    found = backends.compare_index_with_store(kept.settings, full=True, settles_s=0.0) if of_values else look()
    assert not found.ok and shard in found.message and words in found.message and "index rebuild" in found.fix


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
