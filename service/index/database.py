"""Connection to the index database, SQLite in WAL mode or PostgreSQL; the first open makes the tables.

There are no migrations: `graspd admin index rebuild` replaces an index of another revision. Columns of new metrics are
added, with NULL for existing grasps; columns of removed metrics stay.
"""

from __future__ import annotations

import base64
import fcntl
import json
import logging
import sqlite3
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, nullcontext
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, TypedDict, TypeVar, Unpack

import sqlalchemy as sa
from pydantic_core import from_json
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.exc import ArgumentError, DataError, NoSuchModuleError, SQLAlchemyError

from graspd.service.index.tables import assets, grasps, jobs, metadata, tasks
from graspd.service.model.base import first_line
from graspd.service.model.errors import IndexDamaged, IndexUnavailable, InputError, NotFoundError
from graspd.service.model.metrics import indexed_metrics
from graspd.service.model.projects import ProjectScope

log = logging.getLogger(__name__)
T = TypeVar("T")
#: Revision of `service.index.tables`: it changes with every change of the tables except for new metrics.
REVISION: Final = "0022"
#: Table with the revision. graspd 0.2 also reads this table, and refuses an index of an unknown revision.
REVISION_TABLE: Final = "alembic_version"
#: Maximum time to wait for other writers [s], whose transactions may take a few seconds.
_BUSY_TIMEOUT_S: Final = 20.0
#: Key of PostgreSQL's advisory lock that a process holds while it makes tables: "grsp" in ASCII.
_TABLES_LOCK: Final = 0x67727370
#: Key of the advisory lock that a process holds until its write transaction ends: "grsq" in ASCII.
_TURN_LOCK: Final = 0x67727371
#: Codes of SQLite for a file with invalid content.
_DAMAGED: Final = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)


class Database:
    """Connection pool; reads and writes are context managers."""

    def __init__(self, url: str | sa.URL, *, anew: bool = False) -> None:
        """Connect, and make the tables of an empty database; `anew` replaces tables of another revision.

        InputError: unusable URL. IndexUnavailable: no answer, a read-only database, or another revision.
        """
        self._url = url
        self._anew = anew
        self.was = ""
        with convert_url_errors():
            parsed = sa.make_url(url)
            is_file = parsed.get_backend_name() == "sqlite" and parsed.database and parsed.database != ":memory:"
        self._file = SqliteFile(Path(str(parsed.database))) if is_file else None
        self._write_lock = threading.Lock()
        self._opening = threading.Lock()
        self._identity: Identity = None
        try:
            self._engine = self._open()
        except IndexDamaged:
            self._move_damaged_file()
            self._engine = self._open()

    @contextmanager
    def read_transaction(self, within: sa.Connection | None = None) -> Iterator[sa.Connection]:
        """Yield a connection whose queries all see one snapshot, or the given connection."""
        if within is not None:
            yield within
            return
        with self._handle_errors(), self._current_engine().connect() as connection:
            if connection.dialect.name == "sqlite":
                connection.exec_driver_sql("BEGIN")
            else:
                connection.execution_options(isolation_level="REPEATABLE READ")
            yield connection

    @contextmanager
    def write_transaction(self, within: sa.Connection | None = None) -> Iterator[sa.Connection]:
        """Yield the given transaction, or a new one, committed as a whole; only one runs at a time."""
        if within is not None:
            yield within
            return
        with self._handle_errors(), self._write_lock, self._current_engine().connect() as connection:
            if connection.dialect.name == "sqlite":
                # A deferred transaction would fail at once if another one writes between its reads and writes.
                connection.exec_driver_sql("BEGIN IMMEDIATE")
            else:
                connection.exec_driver_sql(f"SET LOCAL lock_timeout = '{_BUSY_TIMEOUT_S:g}s'")
                connection.execute(sa.text("SELECT pg_advisory_xact_lock(:key)"), {"key": _TURN_LOCK})
            yield connection
            connection.commit()

    def rows(self, query: sa.Select[Any], within: sa.Connection | None = None) -> Sequence[sa.RowMapping]:
        with self.read_transaction(within) as connection:
            return connection.execute(query).mappings().all()

    def first_row(self, query: sa.Select[Any], what: str, within: sa.Connection | None = None) -> sa.RowMapping:
        """Return the first row; NotFoundError `there is no {what}` if there is none."""
        if not (found := self.rows(query, within)):
            raise NotFoundError(f"there is no {what}")
        return found[0]

    def column(self, query: sa.Select[Any]) -> list[Any]:
        with self.read_transaction() as connection:
            return list(connection.scalars(query))

    def matching_rows(self, query: sa.Select[Any], column: sa.ColumnElement[Any], wanted: Iterable[Any]) -> list[Any]:
        """Return the rows whose column has one of the wanted values, which may be any number of values."""
        with self.read_transaction() as connection:
            return list(rows_in(connection, query, column, wanted))

    def value(self, query: sa.Select[Any], within: sa.Connection | None = None) -> Any:
        """Return the first column of the first row; None without rows."""
        with self.read_transaction(within) as connection:
            return connection.scalar(query)

    def ping(self) -> float:
        """Return the duration of a query [s]."""
        start = time.perf_counter()
        self.value(sa.select(1))
        return time.perf_counter() - start

    def close(self) -> None:
        self._engine.dispose()

    def _open(self) -> sa.Engine:
        engine = _engine(self._url)
        try:
            with convert_errors(), self._file.lock_for_opening() if self._file is not None else nullcontext():
                self._store_identity()
                self.was = _make_tables(engine, anew=self._anew) or self.was
                self._store_identity()
        except BaseException:
            engine.dispose()
            raise
        return engine

    def _store_identity(self) -> None:
        self._identity = self._file.identity() if self._file is not None else None

    def _current_engine(self) -> sa.Engine:
        """Return the engine, or a new one if the file was removed or replaced."""
        if self._file is not None and self._file.identity() != self._identity:
            with self._opening:
                if self._file.identity() != self._identity:
                    log.warning("the index %s was removed or replaced; it is opened again", self._file.path)
                    old, self._engine = self._engine, self._open()
                    old.dispose()
        return self._engine

    @contextmanager
    def _handle_errors(self) -> Iterator[None]:
        """Convert errors; move a damaged file away, so that the next call makes a new file."""
        try:
            with convert_errors():
                yield
        except IndexDamaged:
            self._move_damaged_file()
            raise

    def _move_damaged_file(self) -> None:
        if self._file is not None:
            with convert_errors(), self._file.lock_for_opening():
                self._file.set_aside(self._identity)


class IndexPart:
    def __init__(self, database: Database) -> None:
        self.database = database


def chunks(ids: Sequence[T], size: int = 1000) -> Iterable[Sequence[T]]:
    """Yield parts of `ids` for one statement each, because databases limit the number of parameters."""
    return (ids[start : start + size] for start in range(0, len(ids), size))


def rows_in(
    connection: sa.Connection, query: sa.Select[Any], column: sa.ColumnElement[Any], wanted: Iterable[Any]
) -> Iterator[Any]:
    for some in chunks(list(wanted)):
        yield from connection.execute(query.where(column.in_(some)))


def _engine(url: str | sa.URL) -> sa.Engine:
    with convert_url_errors():
        return _sqlite_engine(url) if sa.make_url(url).get_backend_name() == "sqlite" else connect_postgres(url)


@contextmanager
def convert_url_errors() -> Iterator[None]:
    """Convert errors of an unusable index URL to InputError, without a text that may contain a password."""
    try:
        yield
    except (ArgumentError, NoSuchModuleError, ModuleNotFoundError, ValueError) as error:
        why = f" ({_error_line(error)})" if isinstance(error, NoSuchModuleError | ModuleNotFoundError) else ""
        raise InputError(
            f"the index URL (GRASPD_INDEX_URL) cannot be used{why}; give sqlite:///PATH or "
            "postgresql+psycopg://HOST/NAME; in a password, write %2F for / and %40 for @"
        ) from None


def connect_postgres(url: str | sa.URL) -> sa.Engine:
    """Return an engine without making tables; connections raise InputError unless the encoding is UTF-8."""
    engine = sa.create_engine(url, pool_pre_ping=True, pool_size=5, max_overflow=10)

    # Runs before SQLAlchemy inspects the connection: the inspection fails on SQL_ASCII databases, which return bytes.
    @sa.event.listens_for(engine, "connect", insert=True)
    def _require_utf8(connection: Any, _record: Any) -> None:
        info = getattr(connection, "info", None)
        if info is not None and (encoding := info.parameter_status("server_encoding")) != "UTF8":
            raise InputError(
                f"the database of the index has encoding {encoding}, and names need UTF-8; make one by "
                f"`createdb --encoding UTF8 --template template0 {info.dbname}`"
            )

    return engine


def _sqlite_engine(url: str | sa.URL) -> sa.Engine:
    engine = sa.create_engine(url, connect_args={"timeout": _BUSY_TIMEOUT_S})

    @sa.event.listens_for(engine, "connect")
    def _set_pragmas(connection: Any, _record: Any) -> None:
        connection.isolation_level = None  # Only `write_transaction` begins transactions.
        for pragma in ("journal_mode=WAL", "synchronous=NORMAL", "foreign_keys=ON", "temp_store=MEMORY"):
            connection.execute(f"PRAGMA {pragma}")

    return engine


def _make_tables(engine: sa.Engine, *, anew: bool) -> str:
    """Make missing tables; return the revision of dropped tables, "" if none were dropped."""
    dropped = ""
    with _schema_transaction(engine) as connection:
        found = revision_of(connection)
        if found and found != REVISION:
            if not anew:
                raise IndexUnavailable(_revision_mismatch(found))
            existing = sa.MetaData()
            existing.reflect(connection)
            existing.drop_all(connection)
            found, dropped = "", found
        if not found:
            metadata.create_all(connection)
            connection.exec_driver_sql(f"CREATE TABLE {REVISION_TABLE} (version_num VARCHAR(32) NOT NULL)")
            connection.execute(sa.text(f"INSERT INTO {REVISION_TABLE} VALUES (:revision)"), {"revision": REVISION})
        if added := _add_missing_metrics(connection):
            log.info("the index has new columns of grasps: %s", ", ".join(added))
    return dropped


def revision_of(connection: sa.Connection) -> str:
    """Return the revision of a database's tables; "" if it has none yet."""
    if not sa.inspect(connection).has_table(REVISION_TABLE):
        return ""
    return str(connection.scalar(sa.text(f"SELECT version_num FROM {REVISION_TABLE}")) or "")


def _revision_mismatch(found: str) -> str:
    if found > REVISION:
        return f"a newer graspd made the index (revision {found}, here {REVISION}); use that one, or delete the index"
    return f"the index is of an older graspd (revision {found}, here {REVISION}); run `graspd admin index rebuild`"


@contextmanager
def _schema_transaction(engine: sa.Engine) -> Iterator[sa.Connection]:
    """Yield a transaction, committed as a whole or not at all, while no other process makes tables."""
    with engine.connect() as connection:
        if connection.dialect.name == "postgresql":
            connection.execute(sa.text("SELECT pg_advisory_lock(:key)"), {"key": _TABLES_LOCK})
        else:
            connection.exec_driver_sql("BEGIN IMMEDIATE")
        try:
            yield connection
            connection.commit()
        finally:
            if connection.dialect.name == "postgresql":
                connection.rollback()  # Without it, the lock cannot be released after a failed statement.
                connection.execute(sa.text("SELECT pg_advisory_unlock(:key)"), {"key": _TABLES_LOCK})
                connection.commit()


@contextmanager
def convert_errors() -> Iterator[None]:
    """Convert errors of the database to InputError, IndexDamaged or IndexUnavailable."""
    try:
        yield
    except DataError as error:
        # The value is invalid, not the database: retries would never end.
        raise InputError(f"the index cannot store this value: {_error_line(error)}") from error
    except (OverflowError, UnicodeEncodeError):
        raise InputError("the index needs whole numbers below 2^63 and valid Unicode text; give such values") from None
    except SQLAlchemyError as error:
        if getattr(getattr(error, "orig", None), "sqlite_errorcode", 0) & 0xFF in _DAMAGED:
            message = f"the index is damaged ({_error_line(error)}); a new one replaces it and is filled from the store"
            raise IndexDamaged(message) from error
        raise IndexUnavailable(f"the index does not answer or cannot be written: {_error_line(error)}") from error


def _error_line(error: Exception) -> str:
    return first_line(getattr(error, "orig", None) or error)


def _add_missing_metrics(connection: sa.Connection) -> list[str]:
    """Add missing columns and indexes of the table `grasps`; return the names of the columns."""
    found = sa.inspect(connection)
    existing = {column["name"] for column in found.get_columns(grasps.name)}
    missing = [metric.name for metric in indexed_metrics() if metric.name not in existing]
    for name in missing:
        kind = grasps.c[name].type.compile(connection.dialect)
        connection.exec_driver_sql(f"ALTER TABLE {grasps.name} ADD COLUMN {name} {kind}")
    made = {index["name"] for index in found.get_indexes(grasps.name)}
    for index in grasps.indexes:
        if index.name not in made:
            index.create(connection)
    return missing


#: Files that SQLite writes beside an open database: the write-ahead log and its shared memory.
_COMPANIONS: Final = ("-wal", "-shm")
Identity = tuple[int, int] | None


class SqliteFile:
    """File of an SQLite index; a lock prevents opening it while another process moves it away."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def identity(self) -> Identity:
        """Return device and inode of the file, None if absent; another process may replace the file."""
        try:
            facts = self.path.stat()
        except FileNotFoundError:
            return None
        return facts.st_dev, facts.st_ino

    @contextmanager
    def lock_for_opening(self) -> Iterator[None]:
        """Hold the inter-process lock; first remove the log files of a missing database."""
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            lock = self._sidecar(".lock").open("w")
        except OSError as error:
            raise IndexUnavailable(f"the index {self.path} cannot be opened: {error.strerror}") from None
        with lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if self.identity() is None:
                for name in _COMPANIONS:
                    self._sidecar(name).unlink(missing_ok=True)
            yield

    def set_aside(self, damaged: Identity) -> None:
        """Move a damaged file away unless another process did; call within `lock_for_opening`."""
        if damaged is None or self.identity() != damaged:
            return
        suffix = f".damaged-{datetime.now(UTC):%Y%m%dT%H%M%S}"
        log.error("the index %s is damaged and moved to %s%s; a new one replaces it", self.path, self.path, suffix)
        for name in ("", *_COMPANIONS):
            if (found := self._sidecar(name)).exists():
                found.rename(found.with_name(f"{self.path.name}{suffix}{name}"))

    def _sidecar(self, name: str) -> Path:
        return self.path.with_name(f"{self.path.name}{name}")


Row = Mapping[str, Any]


def upsert(connection: sa.Connection, table: sa.Table, rows: Sequence[Row], *, keep: Sequence[str] = ()) -> None:
    """Insert or update rows of equal columns; the last row of a key counts. `keep` is never updated."""
    if not rows:
        return
    keys = [column.name for column in table.primary_key]
    insert: Any = (postgresql if connection.dialect.name == "postgresql" else sqlite).insert(table)
    changed = {name: insert.excluded[name] for name in rows[0] if name not in keys and name not in keep}
    if changed:
        statement = insert.on_conflict_do_update(index_elements=keys, set_=changed)
    else:
        statement = insert.on_conflict_do_nothing(index_elements=keys)
    connection.execute(statement, list(rows))


def update_rows(connection: sa.Connection, table: sa.Table, rows: Sequence[Row], *, state: str) -> None:
    """Update the rows with the given `id` whose column `state` still equals `state`."""
    if not rows:
        return
    values: dict[str, Any] = {name: sa.bindparam(f"new_{name}") for name in rows[0] if name != "id"}
    statement = sa.update(table).where(table.c.id == sa.bindparam("new_id"), table.c.state == state).values(**values)
    connection.execute(statement, [{f"new_{name}": value for name, value in row.items()} for row in rows])


Tests = tuple[sa.ColumnElement[bool], ...]


def scope_conditions(scope: ProjectScope, table: sa.Table) -> Tests:
    """Return the scope's conditions on a table that has a column `project`."""
    return () if scope.everything else (table.c.project == scope.project,)


def scope_conditions_by_job(scope: ProjectScope, table: sa.Table) -> Tests:
    """Return the scope's conditions on a table that has a column `job_id`."""
    of_project = sa.select(jobs.c.id).where(jobs.c.project == scope.project)
    return () if scope.everything else (table.c.job_id.in_(of_project),)


def asset_scope_conditions(scope: ProjectScope) -> Tests:
    """Return the scope's conditions on hands and objects: own, built-in and shared ones."""
    if scope.everything:
        return ()
    return (sa.or_(assets.c.project == scope.project, assets.c.builtin.is_(True), assets.c.shared.is_(True)),)


def asset_scope_order(scope: ProjectScope) -> sa.ColumnElement[int]:
    """Return the sort key of assets of one name: own ones first, then shared ones."""
    shared = sa.or_(assets.c.builtin.is_(True), assets.c.shared.is_(True))
    return sa.case((assets.c.project == scope.project, 0), (shared, 1), else_=2)


def shard_scope_conditions(scope: ProjectScope, shard: sa.ColumnElement[Any]) -> Tests:
    """Return the condition that a job of the scope's project makes or reuses a shard."""
    wanted = (tasks.c.shard_id == shard, tasks.c.job_id == jobs.c.id, jobs.c.project == scope.project)
    return () if scope.everything else (sa.exists().where(*wanted),)


MAX_LIMIT: Final = 200
#: Upper bound of integers in all databases.
_MOST: Final = 2**63


class Paging(TypedDict, total=False):
    """Requested part of a list: at most `limit` items (default: 50) from `cursor` (None: the first page)."""

    limit: int
    cursor: str | None


def page_rows(
    connection: sa.Connection,
    query: sa.Select[Any],
    *key: sa.ColumnElement[Any],
    descending: bool = True,
    **part: Unpack[Paging],
) -> tuple[Sequence[sa.RowMapping], str | None]:
    """Return the rows of a page, ordered by `key`, and the next cursor; InputError as in `decode_cursor`."""
    size = page_size(part.get("limit", 50))
    if (cursor := part.get("cursor")) is not None:
        start = decode_cursor(cursor, *(column.type.python_type for column in key))
        query = query.where(sa.tuple_(*key) < start if descending else sa.tuple_(*key) > start)
    query = query.order_by(*(column.desc() if descending else column for column in key)).limit(size + 1)
    rows = connection.execute(query).mappings().all()
    last = rows[size - 1] if len(rows) > size else None
    return rows[:size], encode_cursor(*(last[str(column.key)] for column in key)) if last is not None else None


def encode_cursor(*key: Any) -> str:
    return base64.urlsafe_b64encode(json.dumps(key, separators=(",", ":")).encode()).decode().rstrip("=")


def decode_cursor(cursor: str, *kinds: type | tuple[type, ...]) -> tuple[Any, ...]:
    """Decode the sort key of a cursor and check its types; InputError for an invalid cursor."""
    try:
        key = from_json(base64.urlsafe_b64decode(cursor + "=" * (-len(cursor) % 4)), allow_inf_nan=False)
    except ValueError:
        raise InputError("the cursor is not from this list; start without a cursor") from None
    if not isinstance(key, list) or len(key) != len(kinds) or not all(map(isinstance, key, kinds)):
        raise InputError("the cursor belongs to another list or another order; start without a cursor")
    if any(isinstance(part, int) and not -_MOST <= part < _MOST for part in key):
        raise InputError("the cursor is not from this list; start without a cursor")
    return tuple(key)


def page_size(limit: int) -> int:
    return min(limit, MAX_LIMIT)


#: Time to wait for a writer before the condition of an index is unknown [s].
_TIMEOUT_S: Final = 5.0


@dataclass(frozen=True)
class IndexCondition:
    """Kind, revision, connections and write permission of an index, read without changes."""

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


def read_condition(url: str | sa.URL) -> IndexCondition | None:
    """Return the condition of an index, None without a file; errors of `Database`, or IndexDamaged."""
    with convert_url_errors():
        if (parsed := sa.make_url(url)).get_backend_name() == "sqlite":
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
            query = f"SELECT version_num FROM {REVISION_TABLE}"
            rows = connection.execute(query).fetchall() if REVISION_TABLE in tables else []
    except sqlite3.DatabaseError as error:
        if getattr(error, "sqlite_errorcode", 0) & 0xFF in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB):
            raise IndexDamaged(f"the index {path} is damaged: {error}") from None
        raise IndexUnavailable(f"the index {path} cannot be read: {error}") from None
    return IndexCondition(f"SQLite {sqlite3.sqlite_version}", rows[0][0] if rows else "", REVISION)


def _postgres_condition(url: str | sa.URL) -> IndexCondition:
    engine = connect_postgres(url)
    try:
        with convert_errors(), engine.connect() as connection:

            def ask(question: str) -> str:
                return str(connection.scalar(sa.text(question)))

            return IndexCondition(
                f"PostgreSQL {ask('SHOW server_version')}",
                revision_of(connection),
                REVISION,
                (int(ask("SELECT count(*) FROM pg_stat_activity")), int(ask("SHOW max_connections"))),
                ask("SELECT pg_is_in_recovery()") == "False"
                and ask("SELECT has_schema_privilege(current_schema(), 'CREATE')") == "True",
            )
    finally:
        engine.dispose()
