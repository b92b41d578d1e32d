"""What is known to be damaged in the store."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy import delete, func, select

from service.index.bulk import upsert
from service.index.database import Database
from service.index.tables import damage
from service.model.clock import timestamp


@dataclass(frozen=True)
class Damage:
    """An object of the store that is not what it was."""

    key: str
    what: str
    shard: str = ""
    found: str = ""


@dataclass(frozen=True)
class KnownDamage:
    """Objects of the store that were found damaged or missing, and not mended since."""

    database: Database

    def known(self, *, limit: int = 100) -> tuple[int, list[Damage]]:
        """Number of damaged objects found so far and not mended, and the first of them."""
        query = select(damage).order_by(damage.c.found, damage.c.key).limit(limit)
        with self.database.reading() as connection:
            count = int(connection.scalar(select(func.count()).select_from(damage)) or 0)
            rows = connection.execute(query).mappings()
            return count, [Damage(row["key"], row["what"], row["shard"], row["found"]) for row in rows]

    def mark(self, found: Sequence[Damage], *, intact: Sequence[str] = ()) -> None:
        """Objects found damaged, and others found intact."""
        rows = [{"key": one.key, "what": one.what, "shard": one.shard, "found": timestamp()} for one in found]
        with self.database.writing() as connection:
            upsert(connection, damage, rows, keep=("found",))
            if intact:
                connection.execute(delete(damage).where(damage.c.key.in_(list(intact))))

    def replace(self, found: Sequence[Damage]) -> None:
        """All that is damaged, after the whole store was looked through."""
        with self.database.writing() as connection:
            connection.execute(delete(damage).where(damage.c.key.not_in([one.key for one in found])))
        self.mark(found)
