"""Condition of an index without opening it, and comparison of a random sample of a large one.

The condition changes nothing, unlike opening the index. The sample has shards and jobs of both index and store.
"""

from __future__ import annotations

import secrets
import sqlite3
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Final

from sqlalchemy import URL, Column, Table, make_url, select, text

from graspd.service.index.database import (
    REVISION,
    REVISION_TABLE,
    UNUSABLE,
    connect_postgres,
    mapped,
    revision_of,
    unusable,
)
from graspd.service.index.index import Index
from graspd.service.index.tables import jobs, shards
from graspd.service.model import names
from graspd.service.model.errors import DamagedError, IndexDamaged, IndexUnavailable, NotFoundError
from graspd.service.model.records import JobRecord
from graspd.service.model.states import Stage
from graspd.service.store.manifests import load_manifest
from graspd.service.store.records import pending, read_record
from graspd.service.store.store import Store

#: Rows per kind from each side.
_SIZE: Final = 100
_READERS: Final = 16
_TIMEOUT_S: Final = 5.0


@dataclass(frozen=True)
class Sample:
    shards: tuple[tuple[Stage, str], ...]
    jobs: tuple[str, ...]


def draw(index: Index, store: Store, *, size: int = _SIZE) -> Sample:
    """Draw shards of each kind and jobs from a random name on: `size` of the index, `size` of the store."""
    chosen: set[tuple[Stage, str]] = set()
    for stage, kind in names.SHARD_KINDS.items():
        chosen |= {(stage, shard) for shard in _rows(index, shards, size, shards.c.kind == kind)}
        found = (key.rpartition("/")[2] for key in _keys(store, f"{names.SHARDS}/{kind}") if key.endswith(".json"))
        chosen |= {(stage, name.removesuffix(".json")) for name in islice(found, size)}
    records = (key.split("/")[1] for key in _keys(store, names.JOBS) if key.endswith("/job.json"))
    some = sorted(_rows(index, jobs, size)) + sorted(set(islice(records, size)))
    return Sample(tuple(sorted(chosen)), tuple(some))


def compare(index: Index, store: Store, sample: Sample) -> list[str]:
    """Return differences of index and store in a sample, one line per shard or job; empty if none."""
    gone = {name for what, name in pending(store) if what == "job"}
    with index.database.reading() as connection:
        ids = [shard for _, shard in sample.shards]
        query = select(shards.c.id, shards.c.sha256, shards.c["count"], shards.c.valid)
        found_rows = connection.execute(query.where(shards.c.id.in_(ids))).all()
        rows = {shard: (sha256, count, valid) for shard, sha256, count, valid in found_rows}
        known = set(connection.scalars(select(jobs.c.id).where(jobs.c.id.in_(sample.jobs))))
    with ThreadPoolExecutor(_READERS) as pool:
        manifests = list(pool.map(lambda one: _manifest(store, *one), sample.shards))
        stored = dict(zip(sample.jobs, pool.map(lambda job: _has_job(store, job), sample.jobs), strict=True))
    found = []
    for (_, shard), said in zip(sample.shards, manifests, strict=True):
        found += [f"shards {shard}: {wrong}" for wrong in _wrong(rows.get(shard), said)]
    for job in sorted(set(sample.jobs) - gone):
        if stored[job] != (job in known):
            found.append(f"jobs {job}: {'not in the index' if stored[job] else 'not in the store'}")
    return found


def _wrong(row: tuple[str, int, int] | None, said: tuple[str, int, int] | None) -> Iterator[str]:
    if row is None and said is not None:
        yield "not in the index"
    elif said is None and row is not None:
        yield "not in the store"
    elif row != said:
        yield f"checksum, count and valid are {row}, the store says {said}"


def _rows(index: Index, table: Table, size: int, *conditions: Any) -> list[str]:
    """Return ids from a random one on, continued from the first if there are too few."""
    key: Column[Any] = table.c.id
    with index.database.reading() as connection:
        query = select(key).where(*conditions).order_by(key).limit(size)
        found = list(connection.scalars(query.where(key >= secrets.token_hex(8))))
        return found if len(found) == size else list(connection.scalars(query))


def _keys(store: Store, prefix: str) -> Iterator[str]:
    """Yield keys of a folder from a random one on, then those before it."""
    start = f"{prefix}/{secrets.token_hex(8)}"
    for entry in store.list(prefix, offset=start):
        yield entry.key
    for entry in store.list(prefix):
        if entry.key <= start:
            yield entry.key


def _manifest(store: Store, stage: Stage, shard: str) -> tuple[str, int, int] | None:
    try:
        found = load_manifest(store, stage, shard)
    except (NotFoundError, DamagedError):
        # The integrity scan reports damaged records; the index omits them.
        return None
    return found.sha256, found.count, found.valid


def _has_job(store: Store, job: str) -> bool:
    try:
        read_record(JobRecord, store, names.job_record(job))
    except (NotFoundError, DamagedError):
        return False
    return True


@dataclass(frozen=True)
class IndexCondition:
    """State that the database reports."""

    kind: str
    revision: str
    """Revision of its tables; "" if it has none yet."""
    newest: str
    connections: tuple[int, int] = (0, 0)
    """Used and allowed connections; zeros if unknown."""
    may_write: bool = True

    @property
    def is_ready(self) -> bool:
        """Whether opening it changes nothing."""
        return bool(self.revision) and self.revision == self.newest


def look(url: str | URL) -> IndexCondition | None:
    """Return the condition of an index; None if the file of an SQLite index does not exist yet.

    Raises:
        InputError, IndexUnavailable: as in `Database`.
        IndexDamaged: the file has invalid content.
    """
    try:
        parsed = make_url(url)
        if parsed.get_backend_name() == "sqlite":
            return _look_at_file(Path(str(parsed.database)))
        return _look_at_postgres(url)
    except UNUSABLE as error:
        raise unusable(error) from None


def _look_at_file(path: Path) -> IndexCondition | None:
    if not path.exists():
        return None
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True, timeout=_TIMEOUT_S)) as connection:
            said = connection.execute("PRAGMA quick_check(1)").fetchone()[0]
            if said != "ok":
                raise IndexDamaged(f"the index {path} is damaged: {said}")
            tables = {name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
            query = f"SELECT version_num FROM {REVISION_TABLE}"
            rows = connection.execute(query).fetchall() if REVISION_TABLE in tables else []
    except sqlite3.DatabaseError as error:
        if getattr(error, "sqlite_errorcode", 0) & 0xFF in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB):
            raise IndexDamaged(f"the index {path} is damaged: {error}") from None
        raise IndexUnavailable(f"the index {path} cannot be read: {error}") from None
    return IndexCondition(f"SQLite {sqlite3.sqlite_version}", rows[0][0] if rows else "", REVISION)


def _look_at_postgres(url: str | URL) -> IndexCondition:
    engine = connect_postgres(url)
    try:
        with mapped(), engine.connect() as connection:

            def ask(question: str) -> str:
                return str(connection.scalar(text(question)))

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
