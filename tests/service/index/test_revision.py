"""Tables of another revision are refused, and `graspd admin index rebuild` makes them anew, on every database."""

import hashlib
from collections.abc import Iterator
from pathlib import Path

import pytest
from sqlalchemy import Engine, create_engine, inspect, text
from typer.testing import CliRunner

from benchmarks.large_index import fill
from graspd.service.index import database
from graspd.service.index.index import Index
from graspd.service.index.queries.grasps import GraspSort
from graspd.service.index.tables import metadata
from graspd.service.model.errors import IndexUnavailable
from graspd.service.model.metrics import indexed_metrics
from graspd.service.run.commands import app
from graspd.service.settings import Settings
from graspd.service.store.store import open_store
from tests.servers import PostgresServer
from tests.service.conftest import DATABASES

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
    store = open_store(f"file://{tmp_path}/store")
    fill(index, store, grasps=64, jobs=2)
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
