"""Condition of an index database, read without changes: `Database` would make or alter its tables."""

import sqlite3
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from sqlalchemy import URL, make_url, text

from graspd.service.index import database
from graspd.service.model.errors import IndexDamaged, IndexUnavailable

_TIMEOUT_S: Final = 5.0


@dataclass(frozen=True)
class IndexCondition:
    """Kind, revision, connections and write permission of an index database."""

    kind: str
    revision: str
    """Revision of the tables; "" before the first open."""
    newest: str
    connections: tuple[int, int] = (0, 0)
    """Used and allowed connections; zeros if unknown."""
    may_write: bool = True

    @property
    def is_ready(self) -> bool:
        """Whether opening the index would change nothing."""
        return bool(self.revision) and self.revision == self.newest


def read_condition(url: str | URL) -> IndexCondition | None:
    """Return the condition of an index, None without a file; errors of `Database`, or IndexDamaged."""
    with database.convert_url_errors():
        if (parsed := make_url(url)).get_backend_name() == "sqlite":
            return _file_condition(Path(str(parsed.database)))
        return _postgres_condition(url)


def _file_condition(path: Path) -> IndexCondition | None:
    if not path.exists():
        return None
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True, timeout=_TIMEOUT_S)) as connection:
            if (result := connection.execute("PRAGMA quick_check(1)").fetchone()[0]) != "ok":
                raise IndexDamaged(f"the index {path} is damaged: {result}")
            tables = {name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
            query = f"SELECT version_num FROM {database.REVISION_TABLE}"
            rows = connection.execute(query).fetchall() if database.REVISION_TABLE in tables else []
    except sqlite3.DatabaseError as error:
        if getattr(error, "sqlite_errorcode", 0) & 0xFF in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB):
            raise IndexDamaged(f"the index {path} is damaged: {error}") from None
        raise IndexUnavailable(f"the index {path} cannot be read: {error}") from None
    return IndexCondition(f"SQLite {sqlite3.sqlite_version}", rows[0][0] if rows else "", database.REVISION)


def _postgres_condition(url: str | URL) -> IndexCondition:
    engine = database.connect_postgres(url)
    try:
        with database.convert_errors(), engine.connect() as connection:

            def ask(question: str) -> str:
                return str(connection.scalar(text(question)))

            return IndexCondition(
                f"PostgreSQL {ask('SHOW server_version')}",
                database.revision_of(connection),
                database.REVISION,
                (int(ask("SELECT count(*) FROM pg_stat_activity")), int(ask("SHOW max_connections"))),
                ask("SELECT pg_is_in_recovery()") == "False"
                and ask("SELECT has_schema_privilege(current_schema(), 'CREATE')") == "True",
            )
    finally:
        engine.dispose()
