"""Streams of events, one for each shard of the keepers' work: Redis itself looks up into how many that is cut.

The first stream has the name that a graspd of one keeper knows: workers of such a version put all their events there,
and so goes what is of no job. A keeper that finds an event of another shard hands it on.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Sequence
from functools import partial
from typing import Any, Final

from redis.exceptions import ResponseError

from service.model.keeper_shards import MOST_SHARDS, place_of
from service.queue import entries
from service.queue.port import Event

EVENTS: Final = "graspd:events"
#: Into how many shards the work is cut; written by who holds the first of them.
NUMBER: Final = "graspd:keeper:shards"
#: Events kept in all streams, 20 MB at most: a minute of a keeper that is away and four hundred tasks a second. Those
#: lost are made good from the store.
EVENTS_KEPT: Final = 50_000
_GROUP: Final = "keeper"
#: In one step with the look at the number, so that who changes it finds all events where they then belong.
_PUBLISH: Final = f"""
local n = tonumber(redis.pcall('GET', KEYS[1])) or 1
if n < 1 or n > {MOST_SHARDS} or n % 1 ~= 0 then n = 1 end
local shard = math.floor(ARGV[1] * n / 4294967296)
local stream = shard == 0 and KEYS[2] or KEYS[2] .. ':' .. shard
redis.call('XADD', stream, 'MAXLEN', '~', math.ceil(ARGV[2] / n), '*', 'e', ARGV[3])
"""
Found = list[tuple[str, Event]]


def stream_name(shard: int) -> str:
    """Stream of a shard."""
    return EVENTS if shard == 0 else f"{EVENTS}:{shard}"


def put_event(pipe: Any, event: Event) -> None:
    """Append an event to the stream of its job's shard."""
    pipe.eval(_PUBLISH, 2, NUMBER, EVENTS, place_of(event.job_id), EVENTS_KEPT, _text(event))


def put_into(pipe: Any, shard: int, event: Event) -> None:
    """Append an event to the stream of a shard, whatever the number of shards is."""
    pipe.xadd(stream_name(shard), {"e": _text(event)}, maxlen=EVENTS_KEPT, approximate=True)


def streams_kept(connection: Any) -> list[str]:
    """Names of the streams that there should be."""
    return [stream_name(shard) for shard in range(number_of(connection))]


def number_of(connection: Any) -> int:
    """Into how many shards the work is cut; 1 where nobody said, or what stands there is no such number."""
    try:
        number = int(connection.get(NUMBER) or 1)
    except (ValueError, ResponseError):
        return 1
    return number if 1 <= number <= MOST_SHARDS else 1


def readable(reply: Any) -> Found:
    """Ids and events of what a read of a single stream gives; what cannot be read is left out."""
    return [(event_id, event) for _, event_id, event in _entries_of(reply) if event is not None]


class EventReader:
    """Reads the streams of shards for the keeper that holds them: first what an earlier one did not acknowledge."""

    def __init__(self, connection: Any) -> None:
        self._connection = connection
        self._unread: dict[int, str] = {}
        """Up to where what an earlier keeper took was read; ">": all of it."""

    def read(self, shards: Collection[int], *, limit: int, wait_s: float) -> Found:
        """Next events, those of each stream oldest first, under ids that name their stream."""
        for shard in shards:
            while (after := self._unread.get(shard, "0")) != ">":
                reply = self._with_groups(shards, partial(self._read, {shard: after}, limit, None))
                last = [event_id for _, event_id, _ in _entries_of(reply)][-1:]
                self._unread[shard] = last[0] if last else ">"
                if pending := self._known(reply):
                    return pending
        block = max(1, int(wait_s * 1000)) if wait_s > 0 else None
        each = -(-limit // max(1, len(shards)))
        return self._known(self._with_groups(shards, partial(self._read, dict.fromkeys(shards, ">"), each, block)))

    def acknowledge(self, event_ids: Iterable[str]) -> None:
        """Events that need not come again."""
        of_stream: defaultdict[str, list[str]] = defaultdict(list)
        for event_id in event_ids:
            stream, _, bare = event_id.partition(" ")
            of_stream[stream].append(bare)
        with self._connection.pipeline(transaction=False) as pipe:
            for stream, ids in of_stream.items():
                pipe.xack(stream, _GROUP, *ids)
            pipe.execute()

    def left_over(self, number: int) -> list[int]:
        """Streams beyond so many that still hold something unread; those read to their end are removed."""
        beyond = range(number, MOST_SHARDS)
        with self._connection.pipeline(transaction=False) as pipe:
            for shard in beyond:
                pipe.exists(stream_name(shard))
            there = [shard for shard, found in zip(beyond, pipe.execute(), strict=True) if found]
        unread = [shard for shard in there if self._holds_unread(stream_name(shard))]
        if done := set(there) - set(unread):
            self._connection.delete(*map(stream_name, done))
        return unread

    def _holds_unread(self, stream: str) -> bool:
        try:
            groups = self._connection.xinfo_groups(stream)
            if not groups:
                return bool(self._connection.xlen(stream))
            newest = self._connection.xinfo_stream(stream)["last-generated-id"]
        except ResponseError as error:
            if entries.is_wrong_type(error):
                return False
            raise
        return any(group["pending"] or group["last-delivered-id"] != newest for group in groups)

    def _with_groups(self, shards: Collection[int], read: Callable[[], Any]) -> Any:
        try:
            return read()
        except ResponseError as error:
            if not str(error).startswith("NOGROUP"):
                raise
        for shard in shards:
            try:
                self._connection.xgroup_create(stream_name(shard), _GROUP, id="0", mkstream=True)
            except ResponseError as error:
                if not str(error).startswith("BUSYGROUP"):
                    raise
        return read()

    def _read(self, after: dict[int, str], limit: int, block: int | None) -> Any:
        names = {stream_name(shard): event_id for shard, event_id in after.items()}
        return self._connection.xreadgroup(_GROUP, _GROUP, names, count=limit, block=block)

    def _known(self, reply: Any) -> Found:
        """Events of a reply. What cannot be read is acknowledged: it is nobody's."""
        found: Found = []
        nobodys: list[str] = []
        for stream, event_id, event in _entries_of(reply):
            if event is None:
                nobodys.append(f"{stream} {event_id}")
            else:
                found.append((f"{stream} {event_id}", event))
        if nobodys:
            self.acknowledge(nobodys)
        return found


def _text(event: Event) -> str:
    return event.model_dump_json(exclude_defaults=True)


def _entries_of(reply: Any) -> Sequence[tuple[str, str, Event | None]]:
    """Stream, id and event of each entry of a reply; an entry that was trimmed has no fields."""
    streams = reply.items() if isinstance(reply, dict) else reply or []
    return [
        (entries.text(stream), event_id.decode(), entries.event(fields.get(b"e")) if fields else None)
        for stream, found in streams
        for entry in found
        for event_id, fields in ([entry] if isinstance(entry, tuple) else entry)
    ]
