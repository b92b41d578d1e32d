"""An index that is lost, removed under its readers, damaged or of another revision; damaged records of a store."""

import hashlib
import json
import os
import sqlite3
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from click.testing import Result
from sqlalchemy import Engine, create_engine, inspect, text
from typer.testing import CliRunner

from benchmarks.large_index import fill
from graspd.service.index import database
from graspd.service.index.index import Index
from graspd.service.index.queries.grasps import GraspSort
from graspd.service.index.rebuild import differences, rebuild
from graspd.service.index.tables import metadata
from graspd.service.model import names
from graspd.service.model.errors import IndexUnavailable
from graspd.service.model.metrics import indexed_metrics
from graspd.service.model.planning import plan_tasks
from graspd.service.model.states import AssetKind, Stage, State
from graspd.service.pipeline import job_actions
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.controller import Controller
from graspd.service.pipeline.lease_reaper import LOST_AFTER_S
from graspd.service.run.commands import app
from graspd.service.settings import Settings
from graspd.service.store.records import add_job_event
from graspd.service.store.store import open_store
from tests.damage import overwrite
from tests.fakes import fail_task, make_shard, message_for, record_of, request
from tests.indexes import empty_index
from tests.memory_queue import MemoryQueue
from tests.servers import PostgresServer
from tests.service.conftest import DATABASES, service
from tests.waiting import Clock

GOOD = 3
DAMAGED = b'{"x": 1}'


@pytest.fixture
def services(tmp_path: Path) -> Iterator[Services]:
    """A service on files with some jobs."""
    for made in service(tmp_path):
        for seed in range(GOOD):
            job_actions.submit(made, request(seed=seed))
        yield made


def lost(services: Services) -> Services:
    index = empty_index(f"sqlite:///{services.settings.data_dir / 'fresh.sqlite'}")
    return Services(services.settings, services.store, index, MemoryQueue())


def shown(index: Index) -> int:
    return len(index.jobs.page(limit=99).items)


def a_job(services: Services) -> str:
    return services.index.jobs.page().items[0].id


def attempt_of(services: Services) -> str:
    return fail_task(services, job := a_job(services), next(plan_tasks(record_of(services, job))), last=False)


def event_of(services: Services) -> str:
    event = add_job_event(services.store, a_job(services), "cancelled")
    return f"{names.job_events_folder(a_job(services))}/{event.number:06}-cancelled.json"


def ball(services: Services) -> tuple[AssetKind, str]:
    return AssetKind.OBJECT, services.index.assets.get(AssetKind.OBJECT, "ball").digest


#: Keys of records, which are there but for those of a dataset.
RECORDS: dict[str, Callable[[Services], str]] = {
    "job": lambda services: names.job_record_key(a_job(services)),
    "manifest": lambda services: names.shard_manifest_key(
        Stage.SYNTHESIZE, make_shard(services.store, message_for()).shard_id
    ),
    "attempt": attempt_of,
    "event": event_of,
    "asset": lambda services: names.asset_key(*ball(services), "asset.json"),
    "check": lambda services: names.asset_key(*ball(services), "check.json"),
    "dataset": lambda services: names.dataset_record_key("kitchen"),
    "snapshot": lambda services: names.dataset_snapshot_key("kitchen", "a" * 32),
}


@pytest.mark.parametrize("record", RECORDS)
def test_a_rebuild_leaves_out_damage_and_names_it(services: Services, record: str) -> None:
    key = RECORDS[record](services)
    overwrite(services.store, key, DAMAGED)
    fresh = lost(services)
    Controller(fresh).run_round()
    assert shown(fresh.index) == GOOD - (record == "job")
    made = fresh.index.notes.completeness()
    assert made is not None and (made.left_out, made.names) == (1, (key,))
    fresh.index.close()


def test_a_record_that_was_mended_is_there_again(services: Services) -> None:
    key = RECORDS["job"](services)
    whole = services.store.get(key)
    overwrite(services.store, key, DAMAGED)
    fresh = lost(services)
    Controller(fresh).run_round()
    overwrite(services.store, key, whole)
    Controller(fresh).run_round()
    assert shown(fresh.index) == GOOD
    assert (made := fresh.index.notes.completeness()) is not None
    assert made.left_out == 0
    fresh.index.close()


def test_a_damaged_attempt_fails_its_task_and_stops_no_round(services: Services) -> None:
    clock, job = Clock(), a_job(services)
    controller = Controller(services, clock=clock)
    overwrite(services.store, attempt_of(services), DAMAGED)
    controller.run_round()
    taken = [services.queue.take("w") for _ in range(GOOD)]  # type: ignore[attr-defined]
    assert job in {delivery.message.job_id for delivery in taken}
    services.queue._held.clear()  # type: ignore[attr-defined]  # Redis lost tasks and leases
    for _ in range(3):
        clock.now += LOST_AFTER_S
        controller.run_round()
    failed = [found.id for found in services.index.jobs.page().items if found.state is State.FAILED]
    assert failed == [job], "the attempts of the others can be counted, and they run again"


@pytest.mark.parametrize("files", ["index.sqlite*", "index.sqlite"])
def test_an_index_removed_under_its_readers_is_made_again(services: Services, files: str) -> None:
    controller = Controller(services)
    controller.run_round()
    other = Index(services.settings.resolved_index_url)
    assert shown(other) == GOOD
    for path in services.settings.data_dir.glob(files):
        path.unlink()
    controller.run_round()
    assert shown(other) == shown(services.index) == GOOD
    job_actions.submit(Services(services.settings, services.store, other, services.queue), request(seed=50))
    assert shown(services.index) == GOOD + 1
    assert differences(services.index, services.store) == []
    other.close()


def scribble(folder: Path, name: str = "index.sqlite", start: int = 0) -> None:
    if name == "index.sqlite":
        with sqlite3.connect(folder / name) as connection:
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    with (folder / name).open("r+b") as file:
        file.write(os.urandom(file.seek(0, os.SEEK_END) - file.seek(start)))


def index_rebuild(services: Services, *more: str) -> Result:
    return CliRunner().invoke(app, ["index", "rebuild", *more, "--data-dir", str(services.settings.data_dir)])


def test_a_damaged_file_gives_way_to_a_rebuilt_one(services: Services) -> None:
    rebuild(services.index, services.store)
    scribble(services.settings.data_dir)
    damaged = (services.settings.data_dir / "index.sqlite").read_bytes()
    told = index_rebuild(services, "--check")
    assert told.exit_code == 1 and "damaged" in told.output
    assert (services.settings.data_dir / "index.sqlite").read_bytes() == damaged, "a check replaces nothing"
    told = index_rebuild(services, "--json")
    assert told.exit_code == 0, told.output
    assert json.loads(told.stdout.splitlines()[-1])["jobs"] == GOOD
    assert shown(services.index) == GOOD, "who had it open sees the new one"
    assert index_rebuild(services, "--check").exit_code == 0


@pytest.mark.parametrize(("name", "start"), [("index.sqlite-wal", 0), ("index.sqlite", 0), ("index.sqlite", 4096)])
def test_a_controller_outlives_a_damaged_index(services: Services, name: str, start: int) -> None:
    controller = Controller(services)
    controller.run_round()
    scribble(services.settings.data_dir, name, start)
    for _ in range(4):
        try:
            controller.run_round()
        except IndexUnavailable:
            continue
    assert shown(services.index) == GOOD
    assert differences(services.index, services.store) == []


#: Digest of the tables of each revision.
TABLES = {"0022": "432488c9"}


@pytest.fixture(params=DATABASES)
def url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """URL of an index with some data, of each kind in turn."""
    if request.param == "postgres":
        server: PostgresServer = request.getfixturevalue("postgres_server")
        made = server.database()
    else:
        made = f"sqlite:///{tmp_path / 'index.sqlite'}"
    index = Index(made)
    fill(index, open_store("memory://"), grasps=64, jobs=2)
    index.close()
    return made


@pytest.fixture
def engine(url: str) -> Iterator[Engine]:
    made = create_engine(url)
    yield made
    made.dispose()


def set_revision(engine: Engine, revision: str) -> None:
    with engine.begin() as connection:
        connection.execute(text("UPDATE alembic_version SET version_num = :it"), {"it": revision})


def columns(engine: Engine) -> dict[str, set[str]]:
    found = inspect(engine)
    return {name: {str(c["name"]) for c in found.get_columns(name)} for name in found.get_table_names()}


def test_other_tables_have_another_revision() -> None:
    """Where this fails, raise `database.REVISION`, and put the new pair here. Metrics of grasps are added without."""
    of_metrics = {metric.name for metric in indexed_metrics()}
    said = [
        f"{table.name}.{column.name} {column.type} {column.nullable} {column.primary_key}"
        for table in metadata.tables.values()
        for column in table.columns
        if column.name not in of_metrics
    ]
    said += [
        f"{index.name} {[column.name for column in index.columns]}"
        for table in metadata.tables.values()
        for index in table.indexes
        if of_metrics.isdisjoint(column.name for column in index.columns)
    ]
    digest = hashlib.sha256("\n".join(sorted(said)).encode()).hexdigest()[:8]
    assert {database.REVISION: digest} == TABLES


def test_an_index_of_an_older_graspd_is_refused_or_emptied(url: str, engine: Engine) -> None:
    wanted = columns(engine)
    set_revision(engine, "0007")
    with engine.begin() as connection:
        connection.execute(text("ALTER TABLE jobs DROP COLUMN reason"))
        connection.execute(text("CREATE TABLE of_another_revision (it INTEGER)"))
    engine.dispose()
    with pytest.raises(IndexUnavailable, match=r"older graspd \(revision 0007.*`graspd admin index rebuild`"):
        Index(url)
    assert "of_another_revision" in columns(engine), "it is left as it was"
    engine.dispose()
    index = Index(url, anew=True)
    assert index.database.was == "0007"
    assert not index.jobs.page().items
    assert index.notes.completeness() is None, "the controller fills it if nobody else does"
    index.close()
    assert columns(engine) == wanted
    Index(url).close()


def test_an_index_of_a_newer_graspd_is_refused_with_the_ways_out(url: str, engine: Engine) -> None:
    set_revision(engine, "9999")
    with pytest.raises(IndexUnavailable, match=r"newer graspd .*9999.*delete the index"):
        Index(url)


def test_an_index_of_this_revision_keeps_its_rows_whoever_asks(url: str) -> None:
    index = Index(url, anew=True)
    assert index.database.was == ""
    assert index.jobs.page().items
    index.close()


def test_the_command_makes_an_older_index_anew(tmp_path: Path) -> None:
    index = Index(Settings(data_dir=tmp_path).resolved_index_url)
    fill(index, open_store(f"file://{tmp_path}/store"), grasps=64, jobs=2)
    index.close()
    old = create_engine(f"sqlite:///{tmp_path / 'index.sqlite'}")
    set_revision(old, "0007")
    old.dispose()
    refused = CliRunner().invoke(app, ["index", "rebuild", "--check", "--data-dir", str(tmp_path)])
    assert refused.exit_code == 1 and "run `graspd admin index rebuild`" in refused.output
    done = CliRunner().invoke(app, ["index", "rebuild", "--data-dir", str(tmp_path)])
    assert done.exit_code == 0, done.output
    assert "revision 0007" in done.output
    made = Index(Settings(data_dir=tmp_path).resolved_index_url)
    assert made.notes.completeness() is not None
    made.close()


def test_a_missing_column_of_a_metric_is_added_and_no_row_lost(url: str, engine: Engine) -> None:
    wanted = columns(engine)
    with engine.begin() as connection:
        rows = connection.scalar(text("SELECT count(*) FROM grasps"))
        connection.execute(text("DROP INDEX grasps_wrench_volume"))
        connection.execute(text("ALTER TABLE grasps DROP COLUMN wrench_volume"))
    index = Index(url)
    found = index.grasps.page(sort=GraspSort(by="wrench_volume"), limit=5).items
    index.close()
    assert [grasp.wrench_volume for grasp in found] == [None] * 5
    assert columns(engine) == wanted
    assert "grasps_wrench_volume" in {index["name"] for index in inspect(engine).get_indexes("grasps")}
    with engine.connect() as connection:
        assert connection.scalar(text("SELECT count(*) FROM grasps")) == rows
