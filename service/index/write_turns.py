"""Whose turn it is to write, on PostgreSQL: advisory locks that end with their transaction.

A writer that may concern anything waits for all others. Several keepers index what their jobs made at the same time:
such a writer names its jobs, and waits for those that concern a job of the same slot. Locks are always taken in one
order: the turn of all, the slots upwards, the feed of ends. Who waits for one holds none behind it, so nobody waits in
a ring.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Final

from sqlalchemy import Connection, text

from service.model.keeper_shards import shard_of

Concerns = Callable[[Connection], Iterable[str]]

#: One writer at a time that may concern anything: the letters "grsq".
_ALL: Final = 0x67727371
#: The same of a slot of jobs, and of the feed of ends.
_SLOT: Final = 0x67727372
_ENDS: Final = 0x67727373
#: Slots of jobs, by their ids: keepers of up to so many shards seldom wait for one another.
_SLOTS: Final = 64


def take_turn(connection: Connection, concerns: Concerns | None) -> None:
    """Wait until this transaction may write.

    Args:
        concerns: finds the ids of the jobs whose tasks it changes. Jobs come and go only by who waits for all.
    """
    if concerns is None:
        connection.execute(text("SELECT pg_advisory_xact_lock(:key)"), {"key": _ALL})
        return
    connection.execute(text("SELECT pg_advisory_xact_lock_shared(:key)"), {"key": _ALL})
    slots = sorted({shard_of(job, _SLOTS) for job in concerns(connection)})
    lock = text("SELECT pg_advisory_xact_lock(:key, slot) FROM unnest(CAST(:slots AS int[])) AS slot")
    connection.execute(lock, {"key": _SLOT, "slots": slots})


def take_turn_of_ends(connection: Connection) -> None:
    """Wait until this transaction may number what ended; the last lock that it takes."""
    if connection.dialect.name == "postgresql":
        connection.execute(text("SELECT pg_advisory_xact_lock(:key)"), {"key": _ENDS})
