"""Migrations up and down with data in them, on every database: no row is lost that the older schema can hold."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from alembic.autogenerate import compare_metadata
from alembic.config import Config
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Engine, create_engine, inspect, text

from benchmarks.large_index import fill
from service.index.database import MIGRATIONS, downgrade
from service.index.filters import GraspSort
from service.index.index import Index
from service.index.tables import metadata
from service.index.views import Stats
from service.model.errors import IndexUnavailable, InputError
from service.store.store import open_store
from tests.servers import PostgresServer
from tests.service.conftest import DATABASES

_CONFIG = Config()
_CONFIG.set_main_option("script_location", str(MIGRATIONS))
REVISIONS = [script.revision for script in ScriptDirectory.from_config(_CONFIG).walk_revisions()][::-1]


@pytest.fixture(params=DATABASES)
def url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """URL of an index with some data that came to be by the migrations, of each kind in turn."""
    if request.param == "postgres":
        server: PostgresServer = request.getfixturevalue("postgres_server")
        made = server.database()
    else:
        made = f"sqlite:///{tmp_path / 'index.sqlite'}"
    index = Index(made)
    fill(index, open_store("memory://"), grasps=600, jobs=20)
    index.close()
    return made


@pytest.fixture
def engine(url: str) -> Iterator[Engine]:
    made = create_engine(url)
    yield made
    made.dispose()


def rows(engine: Engine) -> dict[str, int]:
    """Number of rows of each table that is there."""
    with engine.connect() as connection:
        tables = inspect(connection).get_table_names()
        return {name: connection.scalar(text(f'SELECT count(*) FROM "{name}"')) for name in tables}


def read(url: str) -> tuple[Stats, list[str], list[float | None]]:
    """What the index answers once it is at the newest revision."""
    index = Index(url)
    try:
        jobs = [f"{job.id} {job.state} {job.grasps} {job.valid}" for job in index.jobs.page(limit=50).items]
        return index.overview.stats(), jobs, [grasp.epsilon for grasp in index.grasps.page(limit=200).items]
    finally:
        index.close()


def test_the_schema_goes_back_a_step_at_a_time_and_forward_with_its_rows(url: str, engine: Engine) -> None:
    before, counts = read(url), rows(engine)
    for revision in REVISIONS[-2::-1]:
        downgrade(url, revision)
        kept = rows(engine)
        assert kept["grasps"] > 0, revision
        assert {name: number for name, number in counts.items() if name in kept} == kept, revision
    assert read(url) == before
    with engine.connect() as connection:
        made = MigrationContext.configure(connection, opts={"compare_type": True})
        assert compare_metadata(made, metadata) == []


def test_migrations_only_add_so_that_an_older_process_goes_on_beside_the_newer_one(tmp_path: Path) -> None:
    """Expand, then contract: what an older version reads and writes is dropped one release after nobody uses it."""
    made = f"sqlite:///{tmp_path / 'index.sqlite'}"
    Index(made).close()
    engine = create_engine(made)

    def columns() -> dict[tuple[str, str], bool]:
        """Each column, and whether a row can be put without it."""
        found = inspect(engine)
        return {
            (table, str(column["name"])): bool(column["nullable"]) or column["default"] is not None
            for table in found.get_table_names()
            for column in found.get_columns(table)
        }

    newer = columns()
    for revision in REVISIONS[-2::-1]:
        downgrade(made, revision)
        older = columns()
        tables = {table for table, _ in older}
        assert older.keys() <= newer.keys(), f"after {revision} a column is gone that its processes use"
        added = {name: optional for name, optional in newer.items() if name[0] in tables and name not in older}
        assert all(added.values()), f"after {revision} its processes can put no row: {added}"
        newer = older
    engine.dispose()


def test_the_first_revision_can_be_taken_back_too(url: str, engine: Engine) -> None:
    downgrade(url, "base")
    assert set(rows(engine)) == {"alembic_version"}
    index = Index(url)
    assert not index.feed.has_jobs()
    index.close()


def test_a_revision_that_is_not_there_is_named(url: str) -> None:
    with pytest.raises(InputError, match="'4711'"):
        downgrade(url, "4711")


def test_an_index_of_a_newer_graspd_is_refused_with_the_ways_out(url: str, engine: Engine) -> None:
    with engine.begin() as connection:
        connection.execute(text("UPDATE alembic_version SET version_num = '9999'"))
    with pytest.raises(IndexUnavailable, match=r"another version of graspd .*9999.*delete the index"):
        Index(url)


def test_a_column_of_a_metric_that_is_missing_is_added_with_its_index_and_no_row_is_lost(
    url: str, engine: Engine
) -> None:
    before = rows(engine)
    with engine.begin() as connection:
        connection.execute(text("DROP INDEX grasps_wrench_volume"))
        connection.execute(text("ALTER TABLE grasps DROP COLUMN wrench_volume"))
    index = Index(url)
    found = index.grasps.page(sort=GraspSort(by="wrench_volume"), limit=5).items
    index.close()
    assert [grasp.wrench_volume for grasp in found] == [None] * 5
    assert rows(engine) == before
    with engine.connect() as connection:
        assert compare_metadata(MigrationContext.configure(connection), metadata) == []
