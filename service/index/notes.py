"""What the index knows of itself and of the store: whether it is complete, how far the store was read, which objects
are damaged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

from sqlalchemy import Connection, delete, func, select

from graspd.service.index.bulk import upsert
from graspd.service.index.database import Database
from graspd.service.index.tables import damage, notes
from graspd.service.model.clock import timestamp

_REBUILT: Final = "rebuilt"
_SCAN: Final = "integrity scan"
_CHANGES: Final = "changes"
_MARK: Final = "mark"
_SCAN_TURN: Final = "integrity scan turn"
_SERVICE: Final = "service"
#: Names of records that are kept; the count is of all.
_NAMED: Final = 50


@dataclass(frozen=True)
class IndexCompleteness:
    """How an index came to hold all that the store says, or all but what could not be read."""

    at: str
    left_out: int = 0
    """Damaged records of the store that are not in the index."""
    names: tuple[str, ...] = ()
    """The first of them."""


@dataclass(frozen=True)
class StoreMark:
    """What tells whether the index is as old as the store."""

    mark: str = ""
    """Mark that both have; empty: none yet."""
    before: str = ""
    """The store's mark while it gets that one; then the same."""
    changes: int = 0
    """Changes that there were then."""


@dataclass(frozen=True)
class ScanNote:
    """How far the controller has read through the store in this round."""

    started: str = ""
    ended: str = ""
    """Empty while the round goes on."""
    folder: int = 0
    """Place in the list of folders."""
    after: str = ""
    """Key up to which it has read that folder."""


@dataclass(frozen=True)
class Notes:
    """Notes of the service to itself."""

    database: Database

    def completeness(self) -> IndexCompleteness | None:
        """None while the index may lack what the store has: it is new, and was not made from the store yet."""
        with self.database.reading() as connection:
            value: Any = connection.scalar(select(notes.c.value).where(notes.c.name == _REBUILT))
        return None if value is None else IndexCompleteness(value["at"], value["left_out"], tuple(value["names"]))

    def set_complete(self, left_out: Sequence[str] = (), *, within: Connection | None = None) -> None:
        """From now on the index holds all that the store says, but for these records."""
        value = {"at": timestamp(), "left_out": len(left_out), "names": list(left_out[:_NAMED])}
        with self.database.writing(within) as connection:
            upsert(connection, notes, [{"name": _REBUILT, "value": value}])

    def service(self, *, within: Connection | None = None) -> str | None:
        """Identity of the service that the index belongs to; None in a new one."""
        query = select(notes.c.value).where(notes.c.name == _SERVICE)
        if within is not None:
            value: Any = within.scalar(query)
        else:
            with self.database.reading() as connection:
                value = connection.scalar(query)
        return None if value is None else str(value["id"])

    def name_service(self, identity: str, *, instead: bool = False) -> str:
        """Say which service the index belongs to, where nobody said it before or `instead` of that; the one that
        counts now."""
        with self.database.writing() as connection:
            known = None if instead else self.service(within=connection)
            if known is None:
                upsert(connection, notes, [{"name": _SERVICE, "value": {"id": identity}}])
        return known or identity

    def set_incomplete(self) -> None:
        """The index may lack what the store has; the controller makes it anew."""
        with self.database.writing() as connection:
            connection.execute(delete(notes).where(notes.c.name == _REBUILT))

    def count_change(self, *, within: Connection) -> None:
        """A user's record was put: the index is another one than before."""
        number = int(within.scalar(select(notes.c.value).where(notes.c.name == _CHANGES)) or 0)
        upsert(within, notes, [{"name": _CHANGES, "value": number + 1}])

    def changes(self) -> int:
        """How many of these there were."""
        with self.database.reading() as connection:
            value: Any = connection.scalar(select(notes.c.value).where(notes.c.name == _CHANGES))
        return int(value or 0)

    def marked(self) -> StoreMark:
        """The mark of the index."""
        with self.database.reading() as connection:
            value: Any = connection.scalar(select(notes.c.value).where(notes.c.name == _MARK))
        return StoreMark(**value) if value else StoreMark()

    def set_marked(self, marked: StoreMark, *, within: Connection | None = None) -> None:
        with self.database.writing(within) as connection:
            upsert(connection, notes, [{"name": _MARK, "value": asdict(marked)}])

    def scan_note(self) -> ScanNote:
        """How far the controller has read through the store; nothing read yet: a note of defaults."""
        with self.database.reading() as connection:
            value: Any = connection.scalar(select(notes.c.value).where(notes.c.name == _SCAN))
        return ScanNote(**value) if value else ScanNote()

    def set_scan_note(self, note: ScanNote) -> None:
        with self.database.writing() as connection:
            upsert(connection, notes, [{"name": _SCAN, "value": asdict(note)}])

    def take_scan_turn(self, holder: str, *, is_controller: bool, lasts_s: float) -> bool:
        """Take or keep the right to read through the whole store; False: somebody else has it.

        Args:
            holder: who asks.
            is_controller: a controller gives way to who is none.
            lasts_s: after so long without a call the right is free again [s].
        """
        with self.database.writing() as connection:
            held: Any = connection.scalar(select(notes.c.value).where(notes.c.name == _SCAN_TURN))
            if (
                held
                and held["holder"] != holder
                and held["until"] > timestamp()
                and (is_controller or not held["controller"])
            ):
                return False
            value = {"holder": holder, "controller": is_controller, "until": timestamp(-lasts_s)}
            upsert(connection, notes, [{"name": _SCAN_TURN, "value": value}])
        return True

    def end_scan_turn(self, holder: str) -> None:
        """Free the right, if this one has it."""
        with self.database.writing() as connection:
            held: Any = connection.scalar(select(notes.c.value).where(notes.c.name == _SCAN_TURN))
            if held and held["holder"] == holder:
                connection.execute(delete(notes).where(notes.c.name == _SCAN_TURN))


@dataclass(frozen=True)
class Damage:
    """An object of the store that is not what it was."""

    key: str
    what: str
    shard: str = ""
    found: str = ""


@dataclass(frozen=True)
class KnownDamage:
    """Objects of the store that were found damaged or missing, and not fixed since."""

    database: Database

    def known(self, *, limit: int = 100) -> tuple[int, list[Damage]]:
        """Number of damaged objects found so far and not fixed, and the first of them."""
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
