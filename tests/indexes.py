"""Empty indexes in milliseconds: tables are made once a process, and copied or used again."""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Final

from sqlalchemy import URL, Connection, create_engine, make_url, text

from graspd.service.index.index import Index
from graspd.service.pipeline.backends import Services
from graspd.service.queue.rq_queue import RqQueue
from graspd.service.settings import Settings, sqlite_url
from graspd.service.store.store import Store, open_store
from tests.memory_queue import MemoryQueue
from tests.servers import PostgresServer, schema_of

#: Tables of a schema that hold pages, but for the one that names the revision.
_WRITTEN: Final = text("""
    SELECT c.oid::regclass::text FROM pg_class c JOIN pg_namespace n ON n.oid = c.relnamespace
    WHERE n.nspname = :schema AND c.relkind = 'r' AND c.relname <> 'alembic_version' AND pg_relation_size(c.oid) > 0
""")


def empty_index(url: str | URL) -> Index:
    """`Index(url)` where nothing is yet. Tests of how an index comes to be make theirs themselves."""
    parsed = make_url(url)
    if parsed.get_backend_name() == "sqlite" and not (file := Path(str(parsed.database))).exists():
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(_made())
    return Index(url)


def open_services(settings: Settings, store: Store | None = None, queue: RqQueue | None = None) -> Services:
    """Services of the settings; the queue is in memory. Where there is no index, an empty one is made."""
    index = empty_index(settings.resolved_index_url)
    return Services(settings, store or open_store(settings.resolved_store_url), index, queue or MemoryQueue())


@cache
def _made() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "index.sqlite"
        Index(sqlite_url(file)).close()
        return file.read_bytes()


class EmptySchemas:
    """Schemas of a PostgreSQL with the empty tables of an index. One that was given back is emptied and lent again once
    nobody is connected to it any more; who changes tables, and not only rows, takes `server.database()`."""

    def __init__(self, server: PostgresServer) -> None:
        self._server = server
        self._returned: list[str] = []
        self._engine = create_engine(server.url(), isolation_level="AUTOCOMMIT")

    @contextmanager
    def lent(self) -> Iterator[str]:
        with self._engine.connect() as connection:
            url = self._emptied(connection) or self._made(connection)
        yield url
        self._returned.append(url)

    def close(self) -> None:
        self._engine.dispose()

    def _emptied(self, connection: Connection) -> str | None:
        busy = set(connection.scalars(text("SELECT application_name FROM pg_stat_activity")))
        url = next((url for url in self._returned if schema_of(url) not in busy), None)
        if url is not None:
            self._returned.remove(url)
            # Not DELETE: what comes later lies where it would lie in new tables.
            if written := connection.scalars(_WRITTEN, {"schema": schema_of(url)}).all():
                connection.exec_driver_sql(f"TRUNCATE {', '.join(written)}")
        return url

    def _made(self, connection: Connection) -> str:
        url = self._server.database()
        Index(url).close()
        written = connection.scalars(_WRITTEN, {"schema": schema_of(url)}).all()
        assert not written, f"a new index has rows in {written}: to empty these would lose them"
        return url
