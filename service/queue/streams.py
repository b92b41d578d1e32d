"""The bounded stream of events: workers, API and controller append, the controller that leads reads."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any, Final

from redis.exceptions import ResponseError

from service.queue import entries
from service.queue.port import Event

EVENTS: Final = "graspd:events"
#: Events kept, 20 MB at most: a minute of a controller that is away and four hundred tasks a second. Lost ones are
#: made good from the store.
EVENTS_KEPT: Final = 50_000
#: Group of readers, by the name that graspd 0.2 gave it: a controller goes on where one of 0.2 ended.
_GROUP: Final = "keeper"
Found = list[tuple[str, Event]]


def put_event(pipe: Any, event: Event) -> None:
    """Append an event."""
    pipe.xadd(EVENTS, {"e": event.model_dump_json(exclude_defaults=True)}, maxlen=EVENTS_KEPT, approximate=True)


def readable(reply: Any) -> Found:
    """Ids and events of what a read gives; what cannot be read is left out."""
    return [(event_id, event) for event_id, event in _entries_of(reply) if event is not None]


class EventReader:
    """Reads the stream for the controller: first what an earlier one did not acknowledge."""

    def __init__(self, connection: Any) -> None:
        self._connection = connection
        self._unread = "0"
        """Up to where what an earlier controller took was read; ">": all of it."""

    def read(self, *, limit: int, wait_s: float) -> Found:
        """Next events, the oldest first."""
        while self._unread != ">":
            reply = self._with_group(partial(self._read, self._unread, limit, None))
            last = [event_id for event_id, _ in _entries_of(reply)][-1:]
            self._unread = last[0] if last else ">"
            if pending := self._known(reply):
                return pending
        block = max(1, int(wait_s * 1000)) if wait_s > 0 else None
        return self._known(self._with_group(partial(self._read, ">", limit, block)))

    def acknowledge(self, event_ids: Iterable[str]) -> None:
        """Events that need not come again."""
        if ids := list(event_ids):
            self._connection.xack(EVENTS, _GROUP, *ids)

    def _with_group(self, read: Callable[[], Any]) -> Any:
        try:
            return read()
        except ResponseError as error:
            if not str(error).startswith("NOGROUP"):
                raise
        try:
            self._connection.xgroup_create(EVENTS, _GROUP, id="0", mkstream=True)
        except ResponseError as error:
            if not str(error).startswith("BUSYGROUP"):
                raise
        return read()

    def _read(self, after: str, limit: int, block: int | None) -> Any:
        return self._connection.xreadgroup(_GROUP, _GROUP, {EVENTS: after}, count=limit, block=block)

    def _known(self, reply: Any) -> Found:
        """Events of a reply. What cannot be read is acknowledged: it is nobody's."""
        self.acknowledge(event_id for event_id, event in _entries_of(reply) if event is None)
        return readable(reply)


def _entries_of(reply: Any) -> Sequence[tuple[str, Event | None]]:
    """Id and event of each entry of a reply; an entry that was trimmed has no fields."""
    streams = reply.items() if isinstance(reply, dict) else reply or []
    return [
        (event_id.decode(), entries.read(Event, fields.get(b"e")) if fields else None)
        for _, found in streams
        for entry in found
        for event_id, fields in ([entry] if isinstance(entry, tuple) else entry)
    ]
