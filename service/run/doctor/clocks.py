"""The clock of this machine against those of Redis, database, store and workers.

Leases go by each process's own monotonic clock, so work goes on whatever the clocks say. What suffers: times that users
see and sort by, keys that expire, the grace of shards, and requests to S3, which are refused beyond fifteen minutes.
"""

from __future__ import annotations

import secrets
from collections.abc import Iterator
from contextlib import closing, suppress
from datetime import UTC, datetime
from typing import Final

from redis.exceptions import RedisError
from sqlalchemy import URL, make_url, text
from sqlalchemy.exc import SQLAlchemyError

from service.index.database import connect_postgres
from service.model.errors import GraspdError
from service.model.finding import Finding, bad, good, skipped, warning
from service.queue.rq_queue import open_queue
from service.run.doctor.machine import local_store
from service.run.doctor.redis_server import connection, is_there
from service.settings import Settings
from service.store.store import open_store

_OFF_S: Final = 2.0
_WRONG_S: Final = 300.0
_MEND: Final = "timedatectl set-ntp true, or chronyd, on the machine that is wrong: it differs from all others"


def clocks(settings: Settings) -> Finding:
    """How far the others' clocks are from this one."""
    name = "clocks"
    offsets = dict(_offsets(settings))
    if not offsets:
        return skipped(name, "no clock but this machine's is within reach")
    line = ", ".join(
        f"{who} {offset:+.1f} s" for who, offset in sorted(offsets.items(), key=lambda one: -abs(one[1]))[:5]
    )
    most = max(abs(offset) for offset in offsets.values())
    if most > _WRONG_S:
        return bad(
            name, f"clocks differ from this one: {line}; S3 refuses such requests, and keys expire wrongly", _MEND
        )
    if most > _OFF_S:
        return warning(name, f"clocks differ from this one: {line}", _MEND)
    return good(name, f"within {_OFF_S:.0f} s: {line}")


def _offsets(settings: Settings) -> Iterator[tuple[str, float]]:
    """Who, and how far ahead of this machine [s]; what is away is told by its own check."""
    if is_there(settings):
        with suppress(RedisError, OSError), connection(settings) as client:
            before = _now()
            seconds, micros = client.time()
            yield "Redis", seconds + micros / 1e6 - (before + _now()) / 2
        with suppress(GraspdError), closing(open_queue(settings, patience=0)) as queue:
            beats = queue.workers()
            # A beat that was given just now and one that is due are as good: what lies outside is the clock.
            due = 4 / 3 * settings.lease_s
            ages = {beat.host: _now() - _seconds(beat.seen) for beat in beats}
            yield from ((host, -age if age < 0 else min(0.0, due - age)) for host, age in ages.items())
    if settings.index_url is not None and make_url(settings.resolved_index_url).get_backend_name() == "postgresql":
        with suppress(SQLAlchemyError, GraspdError):
            yield "PostgreSQL", _of_postgres(settings.resolved_index_url)
    folder = local_store(settings)
    if folder is None or folder.exists():
        with suppress(GraspdError):
            yield "store", _of_store(settings)


def _of_postgres(url: str | URL) -> float:
    engine = connect_postgres(url)
    try:
        with engine.connect() as connected:
            before = _now()
            return float(connected.scalar(text("SELECT extract(epoch FROM clock_timestamp())"))) - (before + _now()) / 2
    finally:
        engine.dispose()


def _of_store(settings: Settings) -> float:
    """What the store says of an object made just now; whole seconds are all that some tell."""
    store, key = open_store(settings.resolved_store_url), f"health/clock-{secrets.token_hex(8)}"
    before = _now()
    try:
        store.put(key, b"1")
        after = _now()
        made = _seconds(store.stamp(key)[1])
    finally:
        store.delete(key)
    return 0.0 if before - 1.0 <= made <= after + 1.0 else made - (before + after) / 2


def _seconds(when: str) -> float:
    return datetime.fromisoformat(when).timestamp()


def _now() -> float:
    return datetime.now(UTC).timestamp()
