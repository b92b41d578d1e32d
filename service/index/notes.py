"""What the index knows of itself: whether it was made whole. And what is known to be damaged in the store."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

from sqlalchemy import Connection, delete, func, select

from service.clock import timestamp
from service.index.database import Database, upsert
from service.index.tables import damage, notes

_REBUILT: Final = "rebuilt"
#: Names of records that are kept; the count is of all.
_NAMED: Final = 50


@dataclass(frozen=True)
class Completeness:
    """How an index came to hold all that the store says, or all but what could not be read."""

    at: str
    left_out: int = 0
    """Damaged records of the store that are not in the index."""
    names: tuple[str, ...] = ()
    """The first of them."""


@dataclass(frozen=True)
class Damage:
    """An object of the store that is not what it was."""

    key: str
    what: str
    shard: str = ""
    found: str = ""


class Notes(Database):
    """Part of the index: see there for errors."""

    def completeness(self) -> Completeness | None:
        """None while the index may lack what the store has: it is new, and was not made from the store yet."""
        with self.reading() as connection:
            value: Any = connection.scalar(select(notes.c.value).where(notes.c.name == _REBUILT))
        return None if value is None else Completeness(value["at"], value["left_out"], tuple(value["names"]))

    def set_complete(self, left_out: Sequence[str] = (), *, within: Connection | None = None) -> None:
        """From now on the index holds all that the store says, but for these records."""
        value = {"at": timestamp(), "left_out": len(left_out), "names": list(left_out[:_NAMED])}
        with self.writing(within) as connection:
            upsert(connection, notes, [{"name": _REBUILT, "value": value}])

    def known_damage(self, *, limit: int = 100) -> tuple[int, list[Damage]]:
        """Number of damaged objects found so far and not mended, and the first of them."""
        query = select(damage).order_by(damage.c.found, damage.c.key).limit(limit)
        with self.reading() as connection:
            count = int(connection.scalar(select(func.count()).select_from(damage)) or 0)
            rows = connection.execute(query).mappings()
            return count, [Damage(row["key"], row["what"], row["shard"], row["found"]) for row in rows]

    def set_damage(self, found: Sequence[Damage], *, intact: Sequence[str] = ()) -> None:
        """Objects found damaged, and others found intact."""
        rows = [{"key": one.key, "what": one.what, "shard": one.shard, "found": timestamp()} for one in found]
        with self.writing() as connection:
            upsert(connection, damage, rows, keep=("found",))
            if intact:
                connection.execute(delete(damage).where(damage.c.key.in_(list(intact))))

    def replace_damage(self, found: Sequence[Damage]) -> None:
        """All that is damaged, after the whole store was looked through."""
        with self.writing() as connection:
            connection.execute(delete(damage).where(damage.c.key.not_in([one.key for one in found])))
        self.set_damage(found)
