"""Notes of the index: completeness, mark, service id, integrity scan, damaged stored objects."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

from sqlalchemy import Connection, delete, func, select

from graspd.service.index.database import IndexPart, upsert
from graspd.service.index.tables import damage, notes
from graspd.service.model.clock import timestamp

_REBUILT: Final = "rebuilt"
_SCAN: Final = "integrity scan"
_CHANGES: Final = "changes"
_MARK: Final = "mark"
_SCAN_PAUSE: Final = "integrity scan pause"
_SERVICE: Final = "service"
#: Maximum number of damaged records that are stored by name; the count includes all.
_NAMED: Final = 50


@dataclass(frozen=True)
class IndexCompleteness:
    """Completeness of a filled index: its time, and the damaged records that the index lacks."""

    at: str
    left_out: int = 0
    """Number of damaged records of the store that are not in the index."""
    names: tuple[str, ...] = ()


@dataclass(frozen=True)
class StoreMark:
    """Mark that detects an older copy of index or store, and the number of changes so far."""

    mark: str = ""
    """Mark that index and store share; empty before the first mark."""
    before: str = ""
    """Previous mark of the store during an update; otherwise equal to `mark`."""
    changes: int = 0


@dataclass(frozen=True)
class ScanNote:
    """Progress of the integrity scan: folder index and last key of the current round."""

    started: str = ""
    ended: str = ""
    """End of the round; empty while it runs."""
    folder: int = 0
    after: str = ""


class Notes(IndexPart):
    def completeness(self) -> IndexCompleteness | None:
        """Return the completeness; None while the index may lack records of the store."""
        value = self._get(_REBUILT)
        return None if value is None else IndexCompleteness(value["at"], value["left_out"], tuple(value["names"]))

    def set_complete(self, left_out: Sequence[str] = (), *, within: Connection | None = None) -> None:
        value = {"at": timestamp(), "left_out": len(left_out), "names": list(left_out[:_NAMED])}
        self._set(_REBUILT, value, within)

    def service_id(self, *, within: Connection | None = None) -> str | None:
        value = self._get(_SERVICE, within)
        return None if value is None else str(value["id"])

    def set_service_id(self, identity: str, *, instead: bool = False) -> str:
        """Set the id of the service if it is unset or `instead` is true; return the id that applies."""
        with self.database.write_transaction() as connection:
            if not instead and (known := self.service_id(within=connection)) is not None:
                return known
            self._set(_SERVICE, {"id": identity}, connection)
        return identity

    def set_incomplete(self) -> None:
        with self.database.write_transaction() as connection:
            connection.execute(delete(notes).where(notes.c.name == _REBUILT))

    def count_change(self, *, within: Connection) -> None:
        self._set(_CHANGES, int(self._get(_CHANGES, within) or 0) + 1, within)

    def change_count(self) -> int:
        return int(self._get(_CHANGES) or 0)

    def store_mark(self) -> StoreMark:
        return StoreMark(**(self._get(_MARK) or {}))

    def set_store_mark(self, marked: StoreMark, *, within: Connection | None = None) -> None:
        self._set(_MARK, asdict(marked), within)

    def scan_note(self) -> ScanNote:
        return ScanNote(**(self._get(_SCAN) or {}))

    def set_scan_note(self, note: ScanNote) -> None:
        self._set(_SCAN, asdict(note))

    def pause_scan(self, lasts_s: float, *, begin: bool = False) -> bool:
        """Pause the integrity scan for `lasts_s` [s]; with `begin`, return False if a pause is active."""
        with self.database.write_transaction() as connection:
            if begin and self.is_scan_paused(within=connection):
                return False
            self._set(_SCAN_PAUSE, timestamp(-lasts_s), connection)
        return True

    def is_scan_paused(self, *, within: Connection | None = None) -> bool:
        return (self._get(_SCAN_PAUSE, within) or "") > timestamp()

    def _get(self, name: str, within: Connection | None = None) -> Any:
        return self.database.value(select(notes.c.value).where(notes.c.name == name), within)

    def _set(self, name: str, value: Any, within: Connection | None = None) -> None:
        with self.database.write_transaction(within) as connection:
            upsert(connection, notes, [{"name": name, "value": value}])


@dataclass(frozen=True)
class Damage:
    """Damage of a stored object, its time of detection, and the shard to which the object belongs."""

    key: str
    what: str
    shard: str = ""
    found: str = ""


class KnownDamage(IndexPart):
    """List of damaged and missing stored objects."""

    def summary(self, *, limit: int = 100) -> tuple[int, list[Damage]]:
        """Return the number of damaged stored objects, and the first of them."""
        query = select(damage).order_by(damage.c.found, damage.c.key).limit(limit)
        with self.database.read_transaction() as connection:
            count = int(connection.scalar(select(func.count()).select_from(damage)) or 0)
            rows = connection.execute(query).mappings()
            return count, [Damage(**row) for row in rows]

    def update(self, found: Sequence[Damage], *, intact: Sequence[str] = ()) -> None:
        rows = [{"key": one.key, "what": one.what, "shard": one.shard, "found": timestamp()} for one in found]
        with self.database.write_transaction() as connection:
            upsert(connection, damage, rows, keep=("found",))
            if intact:
                connection.execute(delete(damage).where(damage.c.key.in_(list(intact))))

    def replace(self, found: Sequence[Damage]) -> None:
        """Replace the list after a full scan of the store."""
        with self.database.write_transaction() as connection:
            connection.execute(delete(damage).where(damage.c.key.not_in([one.key for one in found])))
        self.update(found)
