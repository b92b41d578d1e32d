"""Connection to the index database: SQLite in WAL mode or PostgreSQL, migrated to the present schema when opened."""

from __future__ import annotations

import logging
import sqlite3
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from functools import cache
from pathlib import Path
from typing import Any, Final, TypeVar

from alembic import command
from alembic.config import Config
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from alembic.util import CommandError
from sqlalchemy import URL, Connection, Engine, create_engine, event, make_url, text
from sqlalchemy.exc import ArgumentError, DataError, NoSuchModuleError, SQLAlchemyError

from service.index.metric_columns import add_missing
from service.index.sqlite_file import Identity, SqliteFile
from service.index.write_turns import Concerns, take_turn
from service.model.errors import IndexDamaged, IndexUnavailable, InputError

log = logging.getLogger(__name__)
T = TypeVar("T")
#: Folder of the revisions of the schema.
MIGRATIONS: Final = Path(__file__).parent / "migrations"
#: A job of a million grasps is one transaction of a few seconds; others wait for it.
_BUSY_TIMEOUT_S: Final = 20.0
#: Key of PostgreSQL's advisory lock that lets one process migrate at a time: the letters "grsp".
_MIGRATION_LOCK: Final = 0x67727370
#: What SQLAlchemy raises for a URL.
UNUSABLE: Final = (ArgumentError, NoSuchModuleError, ModuleNotFoundError, ValueError)
#: Codes of SQLite for a file whose content makes no sense.
_DAMAGED: Final = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)


class Database:
    """An engine, with reads and writes as context managers."""

    def __init__(self, url: str | URL) -> None:
        """Connect and migrate.

        Raises:
            InputError: the URL names no known database.
            IndexUnavailable: the database does not answer or cannot be written.
        """
        self._url = url
        self._file = _file_of(url)
        self._write_lock = threading.Lock()
        self._opening = threading.Lock()
        self._identity: Identity = None
        try:
            self._engine = self._open()
        except IndexDamaged:
            self._put_aside()
            self._engine = self._open()

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """A connection for queries, which all see the same moment."""
        with self._mended(), self._present().connect() as connection:
            if connection.dialect.name == "sqlite":
                connection.exec_driver_sql("BEGIN")
            else:
                connection.execution_options(isolation_level="REPEATABLE READ")
            yield connection

    @contextmanager
    def writing(self, within: Connection | None = None, *, concerns: Concerns | None = None) -> Iterator[Connection]:
        """A transaction, or part of the one given: all of it is kept or nothing. Writers take turns, on every database.

        States are derived from facts that are read in the same transaction: two of these at once would each miss what
        the other brings.

        Args:
            concerns: finds the jobs of which it changes tasks and states, and nothing of others. On PostgreSQL it then
                need not wait for writers that concern others.
        """
        if within is not None:
            yield within
            return
        with self._mended(), self._write_lock, self._present().connect() as connection:
            if connection.dialect.name == "sqlite":
                # A transaction that reads first and writes later fails at once when another one wrote in between.
                connection.exec_driver_sql("BEGIN IMMEDIATE")
            else:
                connection.exec_driver_sql(f"SET LOCAL lock_timeout = '{_BUSY_TIMEOUT_S:g}s'")
                take_turn(connection, concerns)
            yield connection
            connection.commit()

    def ping(self) -> float:
        """Seconds a query takes."""
        start = time.perf_counter()
        with self.reading() as connection:
            connection.execute(text("SELECT 1"))
        return time.perf_counter() - start

    def close(self) -> None:
        """Give the connections back."""
        self._engine.dispose()

    def set_aside(self) -> None:
        """Begin with an empty index: the file of this one is moved away. Nothing happens where it is no file."""
        if self._file is not None:
            self._put_aside()
            self._present()

    def _open(self) -> Engine:
        """An engine on the present file, which is made and migrated if need be."""
        engine = _engine(self._url)
        try:
            with mapped(), self._file.opening() if self._file is not None else nullcontext():
                self._note_identity()
                _migrate(engine)
                self._note_identity()
        except BaseException:
            engine.dispose()
            raise
        return engine

    def _note_identity(self) -> None:
        self._identity = self._file.identity() if self._file is not None else None

    def _present(self) -> Engine:
        """The engine; another one where the file was removed or exchanged meanwhile."""
        if self._file is not None and self._file.identity() != self._identity:
            with self._opening:
                if self._file.identity() != self._identity:
                    log.warning("the index %s was removed or exchanged; it is opened again", self._file.path)
                    old, self._engine = self._engine, self._open()
                    old.dispose()
        return self._engine

    @contextmanager
    def _mended(self) -> Iterator[None]:
        """Errors as ours; a damaged file is put aside, so that the next call finds a new one."""
        try:
            with mapped():
                yield
        except IndexDamaged:
            self._put_aside()
            raise

    def _put_aside(self) -> None:
        if self._file is not None:
            with mapped(), self._file.opening():
                self._file.set_aside(self._identity)


def chunks(ids: Sequence[T], size: int = 1000) -> Iterable[Sequence[T]]:
    """Ids in parts that a statement may name: databases bound the number of its parameters."""
    return (ids[start : start + size] for start in range(0, len(ids), size))


def _file_of(url: str | URL) -> SqliteFile | None:
    """The file of an SQLite index; None for another database, and for one in memory."""
    try:
        parsed = make_url(url)
    except UNUSABLE:
        return None
    is_file = parsed.get_backend_name() == "sqlite" and parsed.database and parsed.database != ":memory:"
    return SqliteFile(Path(str(parsed.database))) if is_file else None


def _engine(url: str | URL) -> Engine:
    try:
        parsed = make_url(url)
        if parsed.get_backend_name() == "sqlite":
            return _sqlite_engine(url, parsed.database)
        return connect_postgres(url)
    except UNUSABLE as error:
        raise unusable(error) from None


def unusable(error: Exception) -> InputError:
    """What is told of an index URL that cannot be used. What SQLAlchemy says of how it is written may hold a part of
    the password."""
    why = f" ({_line(error)})" if isinstance(error, NoSuchModuleError | ModuleNotFoundError) else ""
    return InputError(
        f"the index URL (GRASPD_INDEX_URL) cannot be used{why}; give sqlite:///PATH or "
        "postgresql+psycopg://HOST/NAME, and in a password %2F for / and %40 for @"
    )


def connect_postgres(url: str | URL) -> Engine:
    """An engine that refuses a database whose encoding is not UTF-8, and migrates nothing."""
    engine = create_engine(url, pool_pre_ping=True, pool_size=5, max_overflow=10)

    # Before SQLAlchemy looks at the connection: it cannot read what a database of SQL_ASCII says, which comes as bytes.
    @event.listens_for(engine, "connect", insert=True)
    def _is_utf8(connection: Any, _record: Any) -> None:
        info = getattr(connection, "info", None)  # other drivers than psycopg have none
        if info is not None and (encoding := info.parameter_status("server_encoding")) != "UTF8":
            raise InputError(
                f"the database of the index has encoding {encoding}, and names need UTF-8; make one by "
                f"`createdb --encoding UTF8 --template template0 {info.dbname}`"
            )

    return engine


def _sqlite_engine(url: str | URL, database: str | None) -> Engine:
    if database and database != ":memory:":
        try:
            Path(database).parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise IndexUnavailable(
                f"the index folder {Path(database).parent} cannot be made: {error.strerror}"
            ) from None
    engine = create_engine(url, connect_args={"timeout": _BUSY_TIMEOUT_S})

    @event.listens_for(engine, "connect")
    def _pragmas(connection: Any, _record: Any) -> None:
        connection.isolation_level = None  # transactions begin where `writing` says
        for pragma in ("journal_mode=WAL", "synchronous=NORMAL", "foreign_keys=ON", "temp_store=MEMORY"):
            connection.execute(f"PRAGMA {pragma}")

    return engine


def downgrade(url: str | URL, revision: str) -> None:
    """Take the schema back to an earlier revision, before an older graspd is installed that knows no later one.

    Raises:
        InputError: there is no such revision, or it is later than the schema's.
    """
    engine = _engine(url)
    try:
        with mapped(), _migrating(engine) as config:
            command.downgrade(config, revision)
    except CommandError as error:
        raise InputError(f"the index cannot go back to revision {revision!r}: {_line(error)}") from None
    finally:
        engine.dispose()


@cache
def newest_revision() -> str:
    """The schema that this graspd makes."""
    return str(ScriptDirectory.from_config(_config()).get_current_head())


def _config() -> Config:
    config = Config()
    config.set_main_option("script_location", str(MIGRATIONS))
    return config


def _migrate(engine: Engine) -> None:
    try:
        with _migrating(engine) as config:
            connection = config.attributes["connection"]
            # Alembic reads every revision to find that there is nothing to do.
            if MigrationContext.configure(connection).get_current_heads() != (newest_revision(),):
                command.upgrade(config, "head")
            if added := add_missing(connection):
                log.info("the index has new columns of grasps: %s", ", ".join(added))
    except CommandError as error:
        raise IndexUnavailable(
            f"the index was made by another version of graspd ({_line(error)}); use that version, or run its "
            "`graspd index downgrade`, or delete the index: it is made again from the store"
        ) from None


@contextmanager
def _migrating(engine: Engine) -> Iterator[Config]:
    """Alembic's configuration while no other process migrates; all of a migration is kept or nothing."""
    with engine.connect() as connection:
        if connection.dialect.name == "postgresql":
            connection.execute(text("SELECT pg_advisory_lock(:key)"), {"key": _MIGRATION_LOCK})
        else:
            connection.exec_driver_sql("BEGIN IMMEDIATE")
        try:
            config = _config()
            config.attributes["connection"] = connection
            yield config
            connection.commit()
        finally:
            if connection.dialect.name == "postgresql":
                connection.rollback()  # what broke off, or the lock could not be given back
                connection.execute(text("SELECT pg_advisory_unlock(:key)"), {"key": _MIGRATION_LOCK})
                connection.commit()


@contextmanager
def mapped() -> Iterator[None]:
    """Errors of the database as ours: InputError, IndexDamaged, IndexUnavailable."""
    try:
        yield
    except DataError as error:
        # Not the database is at fault but what it was to hold: to try again would never end.
        raise InputError(f"the index cannot hold this: {_line(error)}") from error
    except (OverflowError, UnicodeEncodeError):
        raise InputError("the index knows whole numbers below 2^63 and Unicode text; give such values") from None
    except SQLAlchemyError as error:
        if getattr(getattr(error, "orig", None), "sqlite_errorcode", 0) & 0xFF in _DAMAGED:
            raise IndexDamaged(
                f"the index is damaged ({_line(error)}); a new one takes its place, and is filled from the store"
            ) from error
        raise IndexUnavailable(f"the index does not answer or cannot be written: {_line(error)}") from error


def _line(error: Exception) -> str:
    original = getattr(error, "orig", None) or error
    return (str(original).strip().splitlines() or [type(original).__name__])[0]
